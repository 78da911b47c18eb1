"""The manager-based environment: the step and the reset of N robots, in the order of Isaac Lab.

| module | content |
|---|---|
| `env` | the environment: build, step, reset, state |
| `isaaclab_attributes` | further attributes of Isaac Lab's environments |
| `graph_capture` | parts of the step as CUDA graphs |
| `undeclared` | finds values that change between steps and are not declared |
"""

from wheelleg_exp.env.env import ManagerBasedRLEnv, Observations, StepResult

__all__ = ["ManagerBasedRLEnv", "Observations", "StepResult"]
