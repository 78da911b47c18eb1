"""What rules find, and how rules are registered."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import Any

from wheelleg_exp.config.schema import PHYSICS_RULES
from wheelleg_exp.lint.case import Case


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        key: the config key that it speaks of.
        message: what is the matter, with the figures.
        hint: what to do.
        figures: the figures by name, SI units.
        advice: settings, values by config key, each of which ends the finding; empty where the hint names no number.
        rule: the rule's name, filled in by the registry.
        where: the file and line, or the override, that set the key.
    """

    key: str
    message: str
    hint: str
    figures: dict[str, float] = field(default_factory=dict)
    advice: tuple[Mapping[str, Any], ...] = ()
    rule: str = ""
    where: str | None = None

    def line(self) -> str:
        """Return the finding on one line, with its place and how to silence it."""
        place = f" ({self.where})" if self.where else ""
        return f"{self.key}: {self.message}{place}; check.silence.{self.rule} silences it"


RuleFunction = Callable[[Case], Iterator[Finding]]


@dataclass(frozen=True)
class Rule:
    """A rule: its name and what it finds, the first line of its docstring; ``text`` is the whole of it."""

    name: str
    summary: str
    text: str
    function: RuleFunction

    def __call__(self, case: Case) -> list[Finding]:
        """Return the rule's findings."""
        return [replace(finding, rule=self.name) for finding in self.function(case)]


RULES: dict[str, Rule] = {}


def rule(function: RuleFunction) -> RuleFunction:
    """Register a rule under its function's name, by which ``check.silence`` silences it."""
    name = function.__name__
    if name not in PHYSICS_RULES:
        raise ValueError(f"the rule '{name}' is missing in wheelleg_exp.config.schema.PHYSICS_RULES")
    text = inspect.getdoc(function) or name.replace("_", " ")  # Python may run without docstrings
    RULES[name] = Rule(name, text.splitlines()[0].rstrip("."), text, function)
    return function


DIGITS = 2


def at_least(value: float, digits: int = DIGITS) -> float:
    """Return the smallest number of so many digits that is not below ``value``."""
    return float(_rounded(value, digits, ROUND_CEILING))


def at_most(value: float, digits: int = DIGITS) -> float:
    """Return the largest number of so many digits that is not above ``value``."""
    return float(_rounded(value, digits, ROUND_FLOOR))


def above(value: float, digits: int = DIGITS) -> float:
    """Return the smallest number of so many digits above ``value``, or the next one."""
    return float(_rounded(value, digits, ROUND_FLOOR) + _last_place(value, digits))


def below(value: float, digits: int = DIGITS) -> float:
    """Return the largest number of so many digits below ``value``, or the next one."""
    return float(_rounded(value, digits, ROUND_CEILING) - _last_place(value, digits))


def _rounded(value: float, digits: int, rounding: str) -> Decimal:
    exact = Decimal(repr(float(value)))  # 0.03 is three hundredths here, and nothing more
    return exact.quantize(_last_place(value, digits), rounding=rounding) if exact.is_finite() else exact


def _last_place(value: float, digits: int) -> Decimal:
    return Decimal(1).scaleb(Decimal(repr(float(value))).adjusted() - digits + 1)
