"""Define the commands that read configs without running a simulation.

| module | contents |
|---|---|
| `compose`, `explain`, `diff` | the values of a config, their places, and their differences from another config |
| `check`, `doctor` | mistakes in a config; implausible numbers and robots |
"""
