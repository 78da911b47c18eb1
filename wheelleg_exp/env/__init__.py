"""The manager-based environment: the step and the reset of N robots, as Isaac Lab orders them.

| module | what it offers |
|---|---|
| `env` | the environment: build, step, reset, state |
| `faces` | what Isaac Lab's environments have beside that |
| `state_elsewhere` | what terms keep beside their own attributes: saved, or refused by name |
| `captured`, `captured_step` | parts of the step that are recorded and repeated, and which these are |
| `variants` | what such a recording needs when it is repeated |
| `slots` | where objects hold what such a part reads and writes |
| `recorders` | what records: CUDA graphs |
| `host` | whole tensors brought to the host for whoever records them |
"""

from wheelleg_exp.env.env import ManagerBasedRLEnv, Observations, StepResult

__all__ = ["ManagerBasedRLEnv", "Observations", "StepResult"]
