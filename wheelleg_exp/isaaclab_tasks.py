"""Provide the module paths of ``isaaclab_tasks`` whose terms exist here: those of the velocity tasks."""

from wheelleg_exp.isaaclab import TERMS, make_modules

_PARENTS = ("manager_based", "manager_based.locomotion", "manager_based.locomotion.velocity")
make_modules(__name__, {path: ("Isaac Lab's tasks.", {}) for path in _PARENTS})
make_modules(__name__, {f"{_PARENTS[-1]}.mdp": ("The terms of Isaac Lab's velocity tasks.", TERMS)})
__path__: list[str] = []
