"""What each figure is: its label, its unit and its definition, in one place for commands, plots, reports and docs.

| module | what it offers |
|---|---|
| `definition` | one figure, and how figures are written |
| `training` | the scalars of a training |
| `rollout` | the figures of plays and agents |
| `recorded` | what is made of a recording's rows |
"""
