"""The robot."""

from wheelleg_exp.isaaclab.assets import Articulation, ArticulationData

__all__ = ["Articulation", "ArticulationData"]
