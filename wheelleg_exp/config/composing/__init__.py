"""Compose config files and overrides into one tree, and record the source of every value.

| module | contents |
|---|---|
| `compose` | a config from a task and overrides; overrides on a recorded config |
| `compose_sweep` | several configs from one command line; the launchers |
| `config_loader` | Hydra's loader without global state; package lines and `@replaces` lines |
| `provenance` | the file and line of each leaf; the mounted groups |
| `hydra_errors` | Hydra's exceptions as errors with key, place, expected value and nearest name |
"""
