"""Members that the robot's classes declare: cached properties, aliases, and members of Isaac Lab that MuJoCo lacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, TypeVar

import torch

from wheelleg_exp.errors import ConfigError

_Class = TypeVar("_Class", bound=type)


def cached_until_change(compute: Callable[[Any], torch.Tensor]) -> property:
    """Make a property that is computed at most once between two changes of the state."""
    name = compute.__name__

    def get(self: Any) -> torch.Tensor:
        value = self._cache.get(name)
        if value is None:
            value = self._cache[name] = compute(self)
        return value

    return property(get, doc=compute.__doc__)


def concatenation(first: str, second: str, doc: str) -> property:
    """Make a cached property that concatenates two others along the last dimension."""
    name = f"{first}|{second}"

    def get(self: Any) -> torch.Tensor:
        value = self._cache.get(name)
        if value is None:
            value = self._cache[name] = torch.cat((getattr(self, first), getattr(self, second)), dim=-1)
        return value

    return property(get, doc=doc)


def alias_of(name: str) -> property:
    """Make a property that is a second name of another one."""
    return property(attrgetter(name), doc=f"Same as ``{name}``.")


class NotInMuJoCo(ConfigError, AttributeError):
    """A member of Isaac Lab has no counterpart in MuJoCo; ``hasattr`` returns False for it."""


class UnsupportedMember:
    """A member of Isaac Lab that raises ``NotInMuJoCo`` on access.

    Args:
        name: the member.
        why: what MuJoCo lacks, and what to use instead.
    """

    def __init__(self, name: str, why: str) -> None:
        self.name, self.why = name, why

    def __get__(self, instance: object, owner: type) -> Any:
        if instance is None:
            return self
        raise NotInMuJoCo(f"Isaac Lab's '{self.name}' does not exist here: {self.why}", where=type(instance).__name__)


def declare_unsupported(reasons: Mapping[str, str]) -> Callable[[_Class], _Class]:
    """Give a class members that raise ``NotInMuJoCo``, from the reason for each name."""

    def give(owner: _Class) -> _Class:
        for name, why in reasons.items():
            setattr(owner, name, UnsupportedMember(name, why))
        return owner

    return give


def unsupported_members(owner: type) -> dict[str, str]:
    """Return the unsupported members of a class and the reason for each."""
    return {
        name: member.why
        for kind in reversed(owner.__mro__)
        for name, member in vars(kind).items()
        if isinstance(member, UnsupportedMember)
    }
