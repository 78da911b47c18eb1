"""The stock actions."""

from wheelleg_exp.mdp.actions import *  # noqa: F403
