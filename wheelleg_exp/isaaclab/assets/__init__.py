"""What terms import of ``isaaclab.assets``, for annotations: the robot is the scene's one asset."""

from wheelleg_exp.sim.articulation_data import ArticulationData
from wheelleg_exp.sim.robot import Robot

Articulation = RigidObject = AssetBase = RigidObjectCollection = Robot
RigidObjectData = ArticulationData

__all__ = ["Articulation", "ArticulationData", "AssetBase", "RigidObject", "RigidObjectCollection", "RigidObjectData"]
