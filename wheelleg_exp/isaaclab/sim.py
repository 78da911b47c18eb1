"""What terms import of ``isaaclab.sim``, for annotations: what ``env.sim`` is; spawners and USD have no counterpart."""

from wheelleg_exp.env.isaaclab_attributes import Simulation

SimulationContext = Simulation

__all__ = ["SimulationContext"]
