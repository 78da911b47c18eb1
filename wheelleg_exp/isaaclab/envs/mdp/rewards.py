"""The stock rewards."""

from wheelleg_exp.mdp.rewards import *  # noqa: F403
