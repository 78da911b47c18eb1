"""The stock observations."""

from wheelleg_exp.mdp.observations import *  # noqa: F403
