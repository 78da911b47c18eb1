"""Compose, check, and explain the config; most checks of the config import neither torch nor MuJoCo.

| module | contents |
|---|---|
| `composing` | files and overrides become one tree, with the place of every leaf |
| `checking` | every mistake in the tree, all at once |
| `explaining` | the value of a key, its meaning, and the values that the key accepts |
| `key_slots` | the type, default and bounds of each key |
| `schema` | the fixed part of the tree |
| `tree_lookup`, `config_errors` | helpers for trees; several mistakes in one error |
"""
