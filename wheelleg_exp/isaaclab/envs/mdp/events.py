"""The stock events."""

from wheelleg_exp.mdp.events import *  # noqa: F403
