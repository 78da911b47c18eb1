"""The stock commands."""

from wheelleg_exp.mdp.commands import *  # noqa: F403
