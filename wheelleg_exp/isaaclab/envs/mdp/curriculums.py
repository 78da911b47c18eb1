"""The stock curriculums."""

from wheelleg_exp.mdp.curriculums import *  # noqa: F403
