"""Provide the module paths of ``isaaclab_tasks`` whose terms exist here: those of the velocity tasks."""

from wheelleg_exp.isaaclab import TERMS, make_modules

_PARENTS = ("manager_based", "manager_based.locomotion", "manager_based.locomotion.velocity")
make_modules(__name__, {path: ("Isaac Lab's tasks.", {}) for path in _PARENTS})
_PATHS = (f"{_PARENTS[-1]}.mdp", *(f"{_PARENTS[-1]}.mdp.{kind}" for kind in ("curriculums", "rewards", "terminations")))
make_modules(__name__, {path: ("The terms of Isaac Lab's velocity tasks.", TERMS) for path in _PATHS})
__path__: list[str] = []
