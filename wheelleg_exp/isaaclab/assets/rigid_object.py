"""The robot, which is no free body: the name is for annotations."""

from wheelleg_exp.isaaclab.assets import RigidObject, RigidObjectData

__all__ = ["RigidObject", "RigidObjectData"]
