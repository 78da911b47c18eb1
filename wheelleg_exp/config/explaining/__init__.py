"""What stands at a key, what it means, and what else could stand there.

| module | what it offers |
|---|---|
| `explanation` | one key explained |
| `meanings`, `fixed_keys` | what is written about a key |
| `docstrings` | texts in docstrings and YAML comments |
| `alternatives`, `candidates` | what else could stand there, also for completion |
| `catalog` | tasks, groups, options and the library of terms |
| `shapes` | the layout of observations and actions |
| `difference` | two configs compared by meaning |
"""
