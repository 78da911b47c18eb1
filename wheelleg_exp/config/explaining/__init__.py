"""Explain a key: its value, its meaning, and the values that it accepts.

| module | contents |
|---|---|
| `explanation` | one key explained |
| `alternatives` | the values that a key accepts, also for shell completion |
| `key_documentation` | texts about keys: docstrings, YAML comments, and a table |
| `catalog` | tasks, groups, options and the library of terms |
| `json_schema` | a config as a JSON Schema |
| `config_diff` | two configs compared by meaning |
"""
