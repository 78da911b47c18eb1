"""The environment: the order of one step and of one reset."""

from wheelleg_exp.env.env import ManagerBasedRLEnv, Observations, StepResult

__all__ = ["ManagerBasedRLEnv", "Observations", "StepResult"]
