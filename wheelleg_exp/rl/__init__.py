"""The rsl_rl adapter, training, checkpoints that hold everything, and export.

| module | what it offers |
|---|---|
| `trainer` | one iteration: a rollout and an update |
| `algorithm`, `initial` | the algorithm and its networks, and what they begin with |
| `vec_env` | the environment as rsl_rl expects it |
| `options` | what may stand under `agent` |
| `checkpoint`, `digests` | the whole state in a file, and short digests of it |
| `policy`, `export` | a policy alone, and for deployment |
| `episode_log`, `step_means` | what a rollout tells: of episodes, failures counted; of every step |
| `symmetry/` | mirror images of observations and actions |
| `global_draws`, `one_thread` | guards of what repeats |
"""
