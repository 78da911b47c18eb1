"""Provide the module paths of ``isaaclab_tasks`` whose terms exist here: those of the velocity tasks."""

from wheelleg_exp.isaaclab import TERMS, make_modules

_PARENTS = (
    *("manager_based", "manager_based.locomotion", "manager_based.locomotion.velocity"),
    *("core", "core.velocity", "contrib", "contrib.velocity"),  # of Isaac Lab 3.0
)
make_modules(__name__, {path: ("Isaac Lab's tasks.", {}) for path in _PARENTS})
_VELOCITY = [path for path in _PARENTS if path.endswith("velocity")]
_PATHS = [f"{path}.mdp{kind}" for path in _VELOCITY for kind in ("", ".curriculums", ".rewards", ".terminations")]
make_modules(__name__, {path: ("The terms of Isaac Lab's velocity tasks.", TERMS) for path in _PATHS})
__path__: list[str] = []
