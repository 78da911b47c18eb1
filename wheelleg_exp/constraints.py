"""Define constraints, such as bounds, that the type annotations of parameters can contain.

    def track(env: Env, std: Positive, share: Share = 1.0, span: Interval = (0.0, 1.0)) -> torch.Tensor: ...
    def count(env: Env, steps: Annotated[int, AtLeast(2), AtMost(8)]) -> torch.Tensor: ...

``wheelleg check`` and the code that builds objects from a config enforce them, also for user-defined terms, noise,
actuators and sensors. A number must be finite unless its annotation contains ``MayBeInfinite``. The decorator
``relation`` adds a rule about several parameters to a function or class.
"""

from __future__ import annotations

import inspect
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Generic, NamedTuple, TypeVar

_V = TypeVar("_V")


class Constraint(Generic[_V]):
    """A requirement, in the type annotation of a parameter, that the parameter's value must satisfy.

    In error messages, ``form``, such as ``[low, high]``, replaces the expected type's name, and ``text``, such as ``not
    empty``, follows it. If ``broken`` is not empty, it replaces ``VALUE is out of range``.
    """

    form: str = ""
    broken: str = ""
    text: str = ""

    def words(self) -> str:
        """Return the constraint's text for an error message, such as ``at least 0`` in ``a number, at least 0``."""
        return self.text

    def holds(self, value: _V) -> bool:
        """Return whether a value of the annotated type satisfies this constraint."""
        raise NotImplementedError


@dataclass(frozen=True)
class _Compared(Constraint[float]):
    bound: float
    compare: ClassVar[Callable[[Any, Any], Any]]

    def words(self) -> str:
        bound = self.bound
        return f"{self.text} {bound if isinstance(bound, int) else format(bound, 'g')}"

    def holds(self, value: float) -> bool:
        return bool(type(self).compare(value, self.bound))


class AtLeast(_Compared):
    """Not below ``bound``."""

    text, compare = "at least", operator.ge


class Above(_Compared):
    """Greater than ``bound``."""

    text, compare = "more than", operator.gt


class AtMost(_Compared):
    """Not above ``bound``."""

    text, compare = "at most", operator.le


class MayBeInfinite(Constraint[object]):
    """Allows infinite numbers."""

    def holds(self, value: object) -> bool:  # noqa: ARG002
        return True


class Length(Constraint[Sized]):
    """A list of ``count`` numbers."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.form = f"{count} finite numbers"

    def holds(self, value: Sized) -> bool:
        return len(value) == self.count


class NotEmpty(Constraint[Sized]):
    """The constraint that a value is a list, mapping or text with at least one element."""

    text = "not empty"

    def holds(self, value: Sized) -> bool:
        return len(value) > 0


class NotAllZero(Constraint[Sequence[float]]):
    """The constraint that a value is a list of numbers, at least one of which is not 0."""

    text = "not all zero"

    def holds(self, value: Sequence[float]) -> bool:
        return any(value)


class Ordered(Constraint[Sequence[float]]):
    """A range: two numbers, the second not below the first."""

    form = "[low, high]"

    def holds(self, value: Sequence[float]) -> bool:
        return len(value) == 2 and bool(value[0] <= value[1])


class Rising(Ordered):
    """A range that is not empty: two numbers, the second above the first."""

    text = "low below high"

    def holds(self, value: Sequence[float]) -> bool:
        return len(value) == 2 and bool(value[0] < value[1])


class OfNodes(Constraint[object]):
    """A mapping whose values are checked by the code that builds them, because the value's ``_target_`` defines it."""

    form = "a mapping"

    def holds(self, value: object) -> bool:
        return isinstance(value, Mapping)


class Targeted(Constraint[object]):
    """A mapping with a ``_target_``."""

    form = "a mapping with a _target_"
    broken = "there is no _target_, which names the class to build"

    def holds(self, value: object) -> bool:
        return isinstance(value, Mapping) and "_target_" in value


@dataclass(frozen=True)
class Pattern(Constraint[str]):
    """The constraint that a whole text matches a regular expression; ``form`` describes valid texts for the user."""

    expression: str
    form: str

    def holds(self, value: str) -> bool:
        return re.fullmatch(self.expression, value) is not None


Positive = Annotated[float, Above(0)]
NonNegative = Annotated[float, AtLeast(0)]
Share = Annotated[float, AtLeast(0), AtMost(1)]
Count = Annotated[int, AtLeast(1)]
Natural = Annotated[int, AtLeast(0)]
Seed = Annotated[int, AtLeast(0), AtMost(2**63 - 1)]  # limit of torch
Interval = Annotated[Sequence[float], Ordered()]
PositiveInterval = Annotated[Sequence[Positive], Ordered()]
NonNegativeInterval = Annotated[Sequence[NonNegative], Ordered()]
Bounds = Annotated[Sequence[Annotated[float, MayBeInfinite()]], Ordered()]  # may be infinite
# The target of a node defines the node's other keys, so their values are open. A class of rsl_rl defines `Parameters`.
Node = Annotated[Mapping[str, Any], Targeted()]
Terms = Annotated[Mapping[str, Node], OfNodes()]
Parameters = Annotated[Mapping[str, Any], OfNodes()]
PathBelow = Annotated[str, Pattern(r"(?!(.*/)?\.{0,2}(/|$))[^/\\\0][^\\\0]*", "a file's path below a folder")]
Names = str | Annotated[Sequence[str], NotEmpty()]  # regular expressions


class Broken(NamedTuple):
    """A violated rule between parameters: the key below the node, the problem, and the expected value."""

    key: str
    message: str
    expected: str


_Target = TypeVar("_Target", bound=Callable[..., object])
_RULES = "_relations"


def relation(rule: Callable[..., Iterator[Broken]]) -> Callable[[_Target], _Target]:
    """Add a rule about several parameters to a function or class.

    ``rule`` gets the values of the parameters that it names, or of all for ``**``, after each value has been checked.
    """

    def attach(target: _Target) -> _Target:
        setattr(target, _RULES, (*getattr(target, _RULES, ()), rule))
        return target

    return attach


def broken_rules(target: Callable[..., object], given: Mapping[str, object]) -> Iterator[Broken]:
    """Yield the violated rules of a function, class, or base class, whose parameters have the values ``given``."""
    for rule in getattr(target, _RULES, ()):
        names = inspect.signature(rule).parameters
        takes_all = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in names.values())
        yield from rule(**{name: value for name, value in given.items() if takes_all or name in names})
