"""The term library: every public term of the package by section, whether or not a YAML file uses it."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

from wheelleg_exp.config.docstrings import headline
from wheelleg_exp.config.known import type_hints
from wheelleg_exp.terms import INJECTED, signature_parameters

# Module of the library -> the section whose terms it holds.
MODULES = {
    "actions": "actions",
    "commands": "commands",
    "observations": "observations",
    "events": "events",
    "rewards": "rewards",
    "terminations": "terminations",
    "curriculums": "curriculum",
}
LIBRARY = "wheelleg_exp.mdp"


@dataclass(frozen=True)
class LibraryTerm:
    """A term that a config may select.

    Attributes:
        section: the section it belongs to.
        target: its dotted name.
        signature: the parameters that a config sets, with their defaults.
        help: the first line of its docstring.
    """

    section: str
    target: str
    signature: str
    help: str


def library() -> list[LibraryTerm]:
    """Return the public terms, section by section, in the order of their modules."""
    return [
        term for module, section in MODULES.items() for term in _terms(section, import_module(f"{LIBRARY}.{module}"))
    ]


def _terms(section: str, module: ModuleType) -> Iterator[LibraryTerm]:
    for name, found in vars(module).items():
        own = getattr(found, "__module__", None) == module.__name__
        if own and not name.startswith("_") and name == getattr(found, "__name__", None) and is_term(section, found):
            yield LibraryTerm(section, f"{module.__name__}.{name}", signature_of(found), headline(found))


def is_term(section: str, found: Any) -> bool:
    """Tell terms from helpers: a class that leaves no method to others, or a function of the environment."""
    if inspect.isclass(found):
        from wheelleg_exp.managers import TermBase

        return issubclass(found, TermBase) and not _leaves_methods_open(found)
    if not inspect.isfunction(found) or next(iter(inspect.signature(found).parameters), None) != INJECTED[0]:
        return False
    # Events change the environment and return nothing.
    return section != "events" or type_hints(found).get("return") is type(None)


def _leaves_methods_open(kind: type) -> bool:
    """Return whether a method's body only says that it is not implemented."""
    methods = [getattr(kind, name) for name in dir(kind) if not name.startswith("__")]
    codes = [method.__code__ for method in methods if inspect.isfunction(method)]
    return any(code.co_names == (NotImplementedError.__name__,) for code in codes)


def signature_of(target: Any) -> str:
    """Return the parameters that a config may set, as ``name, name=default``."""
    parts = []
    for name, parameter in signature_parameters(target).items():
        default = parameter.default
        plain = default is None or isinstance(default, (bool, int, float, str))
        shown = repr(default) if plain else "..."
        parts.append(name if default is parameter.empty else f"{name}={shown}")
    return ", ".join(parts)
