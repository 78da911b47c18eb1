"""What terms import of ``isaaclab.scene``, for annotations: the scene, whose members are found by their names."""

from wheelleg_exp.sim.scene import Scene

InteractiveScene = Scene

__all__ = ["InteractiveScene"]
