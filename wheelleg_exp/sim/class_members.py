"""Members that the robot's classes declare: cached properties, aliases, and members of Isaac Lab that MuJoCo lacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, NoReturn, TypeVar

import torch

from wheelleg_exp.errors import ConfigError


def cached_until_change(compute: Callable[[Any], torch.Tensor]) -> property:
    """Make a property that is computed at most once between two changes of the state."""
    name = compute.__name__

    def get(self: Any) -> torch.Tensor:
        value = self._cache.get(name)
        if value is None:
            value = self._cache[name] = compute(self)
        return value

    return property(get, doc=compute.__doc__)


def alias_of(name: str) -> property:
    """Make a property that is another one under a second name of Isaac Lab's."""
    return property(attrgetter(name), doc=f"Same as ``{name}``.")


_Class = TypeVar("_Class", bound=type)


class NotInMuJoCo(ConfigError, AttributeError):
    """A member of Isaac Lab's that there is no counterpart of; ``hasattr`` is false of it."""


class UnsupportedMember:
    """A member that is not there.

    Args:
        why: what MuJoCo lacks, and what to use instead.
    """

    def __init__(self, why: str) -> None:
        self.why = why

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: object, owner: type) -> Any:
        if instance is None:
            return self
        return self._refuse(type(instance).__name__)

    def _refuse(self, owner: str) -> NoReturn:
        raise NotInMuJoCo(f"'{self.name}' of Isaac Lab's is not there: {self.why}", where=owner)


def declare_unsupported(reasons: Mapping[str, str]) -> Callable[[_Class], _Class]:
    """Give a class members that are refused.

    Args:
        reasons: why each is absent, by name.
    """

    def give(owner: _Class) -> _Class:
        for name, why in reasons.items():
            member = UnsupportedMember(why)
            member.__set_name__(owner, name)
            setattr(owner, name, member)
        return owner

    return give


def unsupported_members(owner: type) -> dict[str, str]:
    """Return why members of a class are absent, by name."""
    return {
        name: member.why
        for kind in reversed(owner.__mro__)
        for name, member in vars(kind).items()
        if isinstance(member, UnsupportedMember)
    }
