"""Files and overrides become one plain tree, and every leaf keeps the place that it came from.

| module | what it offers |
|---|---|
| `compose` | a config from a task and overrides |
| `amend` | overrides on a config that a run kept |
| `sweep` | one command line, several configs |
| `loader`, `tolerant_loader` | Hydra's loader, kept to itself |
| `headers`, `mounts`, `replacing` | where files land, and which takes another's place |
| `provenance` | the file and line of each leaf |
| `hydra_keys` | settings of Hydra that do something here |
| `primaries` | which primary config words are of |
"""
