"""Commands that read configs and run no simulation.

| module | contents |
|---|---|
| `compose`, `explain`, `diff` | the values of a config, their places, and their differences from another config |
| `check`, `doctor` | mistakes in a config; implausible numbers and robots |
"""
