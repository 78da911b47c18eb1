"""What terms import of ``isaaclab.sensors``, for annotations: the sensors that stand in the scene by name."""

from wheelleg_exp.sim.sensors import *  # noqa: F403
from wheelleg_exp.sim.sensors import Camera

TiledCamera = Camera
