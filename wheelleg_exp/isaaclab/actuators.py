"""What terms import of ``isaaclab.actuators``: the actuator models, to tell those inside the solver from others."""

from wheelleg_exp.sim.actuators import *  # noqa: F403
