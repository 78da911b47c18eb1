"""The composed config: made, checked and explained; free of torch and MuJoCo until it checks.

| module | what it offers |
|---|---|
| `composing` | files and overrides become one tree, with the place of every leaf |
| `checking` | every mistake in it, all at once |
| `explaining` | what stands at a key, what it means, what else could stand there |
| `keys` | the one model of what may stand at a key |
| `schema`, `tree`, `problems` | its fixed part, helpers, several mistakes in one error |
"""
