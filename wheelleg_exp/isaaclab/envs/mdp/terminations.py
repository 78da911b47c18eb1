"""The stock terminations."""

from wheelleg_exp.mdp.terminations import *  # noqa: F403
