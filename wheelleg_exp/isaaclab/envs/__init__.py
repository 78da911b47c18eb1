"""What terms import of ``isaaclab.envs``: the environments, for annotations, and the stock terms as ``mdp``."""

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.isaaclab.envs import mdp

ManagerBasedEnv = ManagerBasedRLEnv

__all__ = ["ManagerBasedEnv", "ManagerBasedRLEnv", "mdp"]
