"""Adapt environments to rsl_rl, train and export policies, and store checkpoints with all state of a training.

| module | content |
|---|---|
| `trainer` | one iteration: collect a rollout, update, log |
| `algorithm`, `network_loading` | the algorithm and its networks, and networks from a checkpoint |
| `ppo_graphs`, `matmul` | CUDA graphs of PPO, and the precision of matrix products |
| `vec_env` | the environment as rsl_rl expects it |
| `options` | the keys of the `agent` section |
| `checkpoint`, `digests`, `policy_average` | the complete state in a file, short digests of it, averaged weights |
| `export` | the policy for deployment |
| `rollout_log` | what a rollout reports: episodes, failures, means over steps |
| `ranks` | several processes that train one policy |
| `symmetry`, `mirror_rules`, `mirror_pairs` | mirror images of observations and actions |
| `determinism` | guards that keep a training reproducible |
"""
