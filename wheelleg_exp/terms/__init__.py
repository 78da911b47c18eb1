"""Configs of terms held against the code that they name, without torch and MuJoCo.

| module | what it offers |
|---|---|
| `binding` | a term node: its target, the manager's fields, the parameters |
| `allowed_targets` | which packages a `_target_` may come from |
| `sections` | the fixed keys of the environment; any section against its dataclass |
| `values` | whether a value fits an annotation |
| `term_errors` | all that is wrong with a term node and the nodes in it |
| `failures` | what goes wrong in the code that a config names, with its key and line |
| `keys` | keys of the tree as text |
"""
