"""Names for a project: of a folder, a Python package, a task and a robot at once."""

from __future__ import annotations

import importlib.util
import keyword
import re
import sys
from itertools import count
from pathlib import Path

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.paths import configs_dir

_FORM = re.compile(r"[A-Za-z][A-Za-z0-9_]*[A-Za-z0-9]")
_FALLBACK = "my_robot"
# Values, not names, to YAML or to the grammar of overrides.
_VALUES = {"null", "true", "false", "yes", "no", "on", "off", "inf", "nan"}
# What the project holds beside its package, and the names that pytest and pip take for their own.
_OWN = {"test", "tests", "configs", "assets", "runs", "build", "dist", "src", "conftest"}
_EXPECTED = "letters, digits and underscores, beginning with a letter, such as my_robot"


class NameTaken(WheellegError):
    """A project cannot have this name, or cannot stand there."""


def require_name(name: str) -> None:
    """Raise NameTaken unless a project may be called ``name``; the error names the nearest valid name."""
    problem = _problem(name)
    if problem is not None:
        raise NameTaken(problem, key=name or "NAME", expected=_EXPECTED, nearest=_nearest(name))


def _problem(name: str) -> str | None:
    if not _FORM.fullmatch(name) or keyword.iskeyword(name) or keyword.issoftkeyword(name):
        return "is no name of a Python package"
    if name.lower() in _VALUES:
        return "is a value in YAML, not a name"
    if name.lower() in _OWN:
        return "is the name of something else in a project"
    stock = _stock(name)
    if stock is not None:
        return f"is the name of a stock config, {stock}"
    if name in sys.stdlib_module_names or importlib.util.find_spec(name) is not None:
        return "is the name of a Python package that is there already"
    return None


def _stock(name: str) -> str | None:
    files = sorted(configs_dir().rglob("*.yaml"))
    for file in sorted(files, key=lambda path: path.parent.name != "task"):  # a task is what one would run into
        if file.stem == name:
            return file.relative_to(configs_dir()).with_suffix("").as_posix()
    return None


def _nearest(name: str) -> str:
    """Return the valid name that is most like a wrong one."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", Path(name).name).strip("_") or _FALLBACK
    plain = plain if plain[0].isalpha() else f"robot_{plain}"
    options = [plain, f"{plain}_robot", f"my_{plain}"]
    return next(option for option in _numbered(options) if _problem(option) is None)


def _numbered(options: list[str]) -> list[str]:
    return options + [f"{options[-1]}{number}" for number, _ in zip(count(2), range(100), strict=False)]
