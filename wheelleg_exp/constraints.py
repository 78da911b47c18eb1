"""What a parameter may be, beside its type: written into its annotation, read by ``check`` and by what builds it.

    def track(env: Env, std: Positive, share: Share = 1.0, span: Interval = (0.0, 1.0)) -> torch.Tensor: ...
    def count(env: Env, steps: Annotated[int, AtLeast(2), AtMost(8)]) -> torch.Tensor: ...

Terms, noise, actuators and sensors of a user's own are held against their annotations like the stock ones. A number is
finite unless its annotation says ``MayBeInfinite``. A rule between several parameters is attached by ``relation``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, TypeVar


class Constraint:
    """What a value of the right type must be.

    ``form`` is told in place of the type, such as ``[low, high]``, and ``broken`` in place of a value that is wrong.
    """

    form: str = ""
    broken: str = ""

    def words(self) -> str:
        """Return what is expected beside the type: ``a number, <words>``."""
        return ""

    def holds(self, value: Any) -> bool:
        """Return whether a value of the annotated type fits."""
        raise NotImplementedError


def _plain(number: float) -> str:
    """Return a number as people write it: whole ones in full."""
    return str(number) if isinstance(number, int) else f"{number:g}"


@dataclass(frozen=True)
class AtLeast(Constraint):
    """Not below ``bound``."""

    bound: float

    def words(self) -> str:
        """Return the bound."""
        return f"at least {_plain(self.bound)}"

    def holds(self, value: Any) -> bool:
        """Return whether it is not below."""
        return bool(value >= self.bound)


@dataclass(frozen=True)
class Above(Constraint):
    """Greater than ``bound``."""

    bound: float

    def words(self) -> str:
        """Return the bound."""
        return f"more than {_plain(self.bound)}"

    def holds(self, value: Any) -> bool:
        """Return whether it is greater."""
        return bool(value > self.bound)


@dataclass(frozen=True)
class AtMost(Constraint):
    """Not above ``bound``."""

    bound: float

    def words(self) -> str:
        """Return the bound."""
        return f"at most {_plain(self.bound)}"

    def holds(self, value: Any) -> bool:
        """Return whether it is not above."""
        return bool(value <= self.bound)


class MayBeInfinite(Constraint):
    """Says that a number may be infinite."""

    def holds(self, value: Any) -> bool:  # noqa: ARG002
        """Return True: it only widens."""
        return True


class Length(Constraint):
    """A list of ``count`` numbers."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.form = f"{count} finite numbers"

    def holds(self, value: Any) -> bool:
        """Return whether it has as many."""
        return len(value) == self.count


class NotEmpty(Constraint):
    """A list, a mapping or a text with something in it."""

    def words(self) -> str:
        """Say so."""
        return "not empty"

    def holds(self, value: Any) -> bool:
        """Return whether there is something."""
        return len(value) > 0


class NotAllZero(Constraint):
    """A list of numbers of which some are not 0."""

    def words(self) -> str:
        """Say so."""
        return "not all zero"

    def holds(self, value: Any) -> bool:
        """Return whether one is not 0."""
        return any(value)


class Ordered(Constraint):
    """A range: two numbers, the second not below the first."""

    form = "[low, high]"

    def holds(self, value: Any) -> bool:
        """Return whether there are two, in order."""
        return len(value) == 2 and bool(value[0] <= value[1])


class Rising(Ordered):
    """A range with room in it: two numbers, the second above the first."""

    def words(self) -> str:
        """Say so."""
        return "low below high"

    def holds(self, value: Any) -> bool:
        """Return whether there are two, and the second is greater."""
        return len(value) == 2 and bool(value[0] < value[1])


class Targeted(Constraint):
    """A mapping that says by ``_target_`` what is built."""

    form = "a mapping with a _target_"
    broken = "there is no _target_, which says what is built"

    def holds(self, value: Any) -> bool:
        """Return whether it says so."""
        return isinstance(value, Mapping) and "_target_" in value


@dataclass(frozen=True)
class Pattern(Constraint):
    """A text that a regular expression matches as a whole; ``form`` says it in words."""

    expression: str
    form: str

    def holds(self, value: Any) -> bool:
        """Return whether it matches."""
        return re.fullmatch(self.expression, value) is not None


Positive = Annotated[float, Above(0)]
NonNegative = Annotated[float, AtLeast(0)]
Share = Annotated[float, AtLeast(0), AtMost(1)]  # a probability, or a part of all
Count = Annotated[int, AtLeast(1)]
Natural = Annotated[int, AtLeast(0)]
Seed = Annotated[int, AtLeast(0), AtMost(2**63 - 1)]  # as wide as recordings and torch take it
Interval = Annotated[Sequence[float], Ordered()]
PositiveInterval = Annotated[Sequence[Positive], Ordered()]
NonNegativeInterval = Annotated[Sequence[NonNegative], Ordered()]
Bounds = Annotated[Sequence[Annotated[float, MayBeInfinite()]], Ordered()]  # may be open to one side
Node = Annotated[Mapping[str, Any], Targeted()]
PathBelow = Annotated[str, Pattern(r"(?!(.*/)?\.{0,2}(/|$))[^/\\\0][^\\\0]*", "a file's path below a folder")]
Names = str | Annotated[Sequence[str], NotEmpty()]  # one regular expression, or several


class Broken(NamedTuple):
    """A rule between parameters that does not hold: at which key below the node, what is wrong, what was expected."""

    key: str
    message: str
    expected: str


Rule = Callable[[Mapping[str, Any]], Iterator[Broken]]
_Target = TypeVar("_Target", bound=Callable[..., Any])
_RULES = "_relations"


def relation(rule: Rule) -> Callable[[_Target], _Target]:
    """Attach a rule between several parameters to a target.

    The rule gets the parameters as the config writes them, defaults included, once each of them is right by itself.
    """

    def attach(target: _Target) -> _Target:
        setattr(target, _RULES, (*getattr(target, _RULES, ()), rule))
        return target

    return attach


def rules_of(target: Callable[..., Any]) -> Sequence[Rule]:
    """Return the rules of a target; of a class, those of the classes above it as well."""
    return getattr(target, _RULES, ())
