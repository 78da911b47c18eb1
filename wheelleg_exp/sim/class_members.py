"""Members that the robot's classes declare: cached properties, aliases, and members of Isaac Lab that MuJoCo lacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from wheelleg_exp.errors import ConfigError

_Class = TypeVar("_Class", bound=type)

if TYPE_CHECKING:

    class TensorProperty:
        """A property that gives a tensor."""

        def __init__(self, get: Callable[[Any], torch.Tensor], *, doc: str | None = None) -> None: ...

        def __get__(self, instance: object, owner: type | None = None) -> torch.Tensor: ...

else:
    TensorProperty = property


def cached_until_change(compute: Callable[[Any], torch.Tensor]) -> TensorProperty:
    """Make a property that computes and caches its value at the first read after each change of the robot's state."""
    name = compute.__name__

    def get(self: Any) -> torch.Tensor:
        value: torch.Tensor | None = self._cache.get(name)
        if value is None:
            value = self._cache[name] = compute(self)
        return value

    return TensorProperty(get, doc=compute.__doc__)


def joined(first: str, second: str, doc: str) -> TensorProperty:
    """Make a cached property that concatenates the tensors of two properties, such as a position and a quaternion."""

    def compute(self: Any) -> torch.Tensor:
        return torch.cat((getattr(self, first), getattr(self, second)), dim=-1)

    compute.__name__, compute.__doc__ = f"{first}|{second}", doc
    return cached_until_change(compute)


def alias_of(name: str, doc: str | None = None) -> property:
    """Return a read-only property that is an alias of an object's nested attribute, such as ``layout.joint_names``."""
    return property(attrgetter(name), doc=doc or f"Same as ``{name}``.")


class NotInMuJoCo(ConfigError, AttributeError):
    """The error for reading an Isaac Lab attribute without a counterpart in MuJoCo; ``hasattr`` gives False for it."""


class UnsupportedMember:
    """A descriptor of an Isaac Lab attribute without a counterpart in MuJoCo; access raises ``NotInMuJoCo``."""

    def __init__(self, name: str, why: str) -> None:
        self.name, self.why = name, why

    def __get__(self, instance: object, owner: type) -> object:
        if instance is None:
            return self
        message = f"Isaac Lab's attribute '{self.name}' does not exist in MuJoCo: {self.why}"
        raise NotInMuJoCo(message, where=type(instance).__name__)


def declare_unsupported(reasons: Mapping[str, str]) -> Callable[[_Class], _Class]:
    """Add attributes to a class that raise ``NotInMuJoCo`` on access, with one reason per attribute name."""

    def give(owner: _Class) -> _Class:
        for name, why in reasons.items():
            setattr(owner, name, UnsupportedMember(name, why))
        return owner

    return give


def unsupported_members(owner: type) -> dict[str, str]:
    """Return the Isaac Lab attributes of a class that MuJoCo does not support, with the reason for each."""
    found = (item for kind in reversed(owner.__mro__) for item in vars(kind).items())
    return {name: member.why for name, member in found if isinstance(member, UnsupportedMember)}
