"""What rules find, and how rules are registered."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from wheelleg_exp.config.schema import PHYSICS_RULES
from wheelleg_exp.physics.case import Case


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        key: the config key that it speaks of.
        message: what is the matter, with the figures.
        hint: what to do.
        figures: the figures by name, SI units.
        rule: the rule's name, filled in by the registry.
        where: the file and line, or the override, that set the key.
    """

    key: str
    message: str
    hint: str
    figures: dict[str, float] = field(default_factory=dict)
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
    text = inspect.getdoc(function) or ""
    RULES[name] = Rule(name, text.splitlines()[0].rstrip("."), text, function)
    return function
