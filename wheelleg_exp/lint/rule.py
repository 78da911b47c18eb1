"""Define the input and the findings of lint rules, register lint rules, and round the values that findings advise."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal

from wheelleg_exp.anatomy.compiled_robot import CompiledRobot, Joint, RobotFacts
from wheelleg_exp.config.schema import PHYSICS_RULES, Experiment
from wheelleg_exp.constraints import Node
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.sim.names import match_names, values_by_name
from wheelleg_exp.sim.options import EnvOptions
from wheelleg_exp.terms.term_binding import TARGET, resolve_target

_LIBRARY = "wheelleg_exp.mdp."


@dataclass(frozen=True)
class TermView:
    """A term of the config.

    ``kind`` is the path of the term's function or class below ``wheelleg_exp.mdp``, such as ``rewards.is_alive``, even
    if the config uses an alias; for other functions and classes, it is the full dotted path.
    """

    name: str
    path: str
    kind: str
    node: Node


@dataclass(frozen=True)
class Case:
    """The input of a lint rule: a valid config and the robot of this config.

    ``robot`` is the compiled model, or None if only the measured ``facts`` are known. ``trial`` maps each reward to its
    mean per second under random actions; None without a simulation. ``of_task`` is False for a robot file.
    """

    config: Experiment
    facts: RobotFacts
    robot: CompiledRobot | None = None
    trial: Mapping[str, float] | None = None
    of_task: bool = True

    @property
    def env(self) -> EnvOptions:
        return self.config.env

    @property
    def agent(self) -> Learning:
        return self.config.agent

    @property
    def physics_dt(self) -> float:
        """The physics time step, s."""
        return float(self.env.sim.dt)

    @property
    def step_dt(self) -> float:
        """The control time step, s."""
        return self.physics_dt * self.env.decimation

    @property
    def episode_s(self) -> float:
        """The length of the longest episode, s."""
        return float(self.env.episode_length_s)

    @property
    def episode_steps(self) -> int:
        """The length of the longest episode in control steps."""
        return math.ceil(round(self.episode_s / self.step_dt, 9))

    def terms(self, section: str, *kinds: str) -> Iterator[TermView]:
        """Yield the terms of a config section; ``kinds`` restricts them to functions such as ``rewards.is_alive``.

        The events that ``env.realism`` replaces never run, so they are left out.
        """
        replaced = self.env.realism.replaces if section == "events" else ()
        sections: dict[str, Mapping[str, Node]] = {f"env.{section}": getattr(self.env, section)}
        if section == "observations":
            sections = {f"env.observations.{n}.terms": group.terms for n, group in self.env.observations.items()}
        for place, nodes in sections.items():
            for name, node in nodes.items():
                kind = kind_of(str(node[TARGET]), f"{place}.{name}")
                if name not in replaced and (not kinds or kind in kinds):
                    yield TermView(name, f"{place}.{name}", kind, node)

    def joints(self, node: Node, name: str = "asset_cfg") -> dict[str, Joint]:
        """Return the joints of a term: those of its scene entity, or of its ``joint_names``, or all joints."""
        entity = node.get(name)
        expressions = entity.get("joint_names") if isinstance(entity, Mapping) else node.get("joint_names")
        if expressions is None:
            return self.facts.joints
        found = match_names(expressions, list(self.facts.joints), key=name, what="joint")[1]
        return {joint: self.facts.joints[joint] for joint in found}


def by_joint(values: float | Mapping[str, float], names: Iterable[str], default: float) -> dict[str, float]:
    """Return a value for each joint; ``values`` is one value for all joints, or a mapping by joint expression."""
    listed = list(names)
    return dict(zip(listed, values_by_name(values, listed, default, key="values", what="joint"), strict=True))


def kind_of(target: str, path: str) -> str:
    """Return a short name of a function or class, such as ``rewards.is_alive`` for a term in ``wheelleg_exp.mdp``."""
    found = resolve_target(target, path)
    module, name = inspect.unwrap(found).__module__, getattr(found, "__qualname__", "")
    if module.startswith(_LIBRARY):
        module = module.removeprefix(_LIBRARY).partition(".")[0]
    return f"{module}.{name}"


def largest(pair: Iterable[float] | None) -> float:
    """Return the larger absolute value of the two ends of a range ``[low, high]``; 0 if the range is None."""
    return max((abs(float(value)) for value in pair), default=0.0) if pair is not None else 0.0


@dataclass(frozen=True)
class Finding:
    """One implausible number in a config, with the problem and what to do.

    ``figures`` maps names such as ``effort`` to numbers in SI units. ``advice`` contains alternative fixes, each of
    which maps keys to new values. ``where`` is the file and line, or the override, that set ``key``.
    """

    key: str
    message: str
    hint: str
    figures: dict[str, float] = field(default_factory=dict)
    advice: tuple[Mapping[str, object], ...] = ()
    rule: str = ""
    where: str | None = None

    def line(self) -> str:
        """Return the finding in one line, with its file and line and the config key that silences its rule."""
        place = f" ({self.where})" if self.where else ""
        return f"{self.key}: {self.message}{place}; check.silence.{self.rule} silences it"


# A lint rule is a function of a ``Case``, or of a ``Case`` and a ``CompiledRobot``.
RuleFunction = Callable[..., Iterator[Finding]]


@dataclass(frozen=True)
class Rule:
    """A registered lint rule, with the rule's docstring ``text`` and the docstring's first line ``summary``."""

    name: str
    summary: str
    text: str
    function: RuleFunction
    takes_robot: bool

    def __call__(self, case: Case) -> list[Finding]:
        if self.takes_robot and case.robot is None:
            return []
        arguments = (case, case.robot) if self.takes_robot else (case,)
        return [replace(finding, rule=self.name) for finding in self.function(*arguments)]


RULES: dict[str, Rule] = {}


def rule(function: RuleFunction) -> RuleFunction:
    """Register a function as a lint rule, which a config can silence by its name in ``check.silence``."""
    name = function.__name__
    if name not in PHYSICS_RULES:
        raise ValueError(f"the lint rule '{name}' is missing in wheelleg_exp.config.schema.PHYSICS_RULES")
    text = inspect.getdoc(function) or name.replace("_", " ")  # Under `python -OO`, functions have no docstrings.
    takes_robot = len(inspect.signature(function).parameters) == 2
    RULES[name] = Rule(name, text.splitlines()[0].rstrip("."), text, function, takes_robot)
    return function


DIGITS = 2


def listed(names: Sequence[str], most: int = 4) -> str:
    """Return a text that quotes at most ``most`` names and, if there are more names, counts the omitted names."""
    shown = ", ".join(f"'{name}'" for name in names[:most])
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def at_least(value: float, digits: int = DIGITS) -> float:
    """Round ``value`` upwards (towards +∞) to ``digits`` significant digits."""
    return float(_rounded(value, digits, ROUND_CEILING))


def at_most(value: float, digits: int = DIGITS) -> float:
    """Round ``value`` downwards (towards -∞) to ``digits`` significant digits."""
    return float(_rounded(value, digits, ROUND_FLOOR))


def above(value: float, digits: int = DIGITS) -> float:
    """Return the next number above ``value`` with ``digits`` significant digits."""
    return float(_rounded(value, digits, ROUND_FLOOR) + _last_place(value, digits))


def below(value: float, digits: int = DIGITS) -> float:
    """Return the next number below ``value`` with ``digits`` significant digits."""
    return float(_rounded(value, digits, ROUND_CEILING) - _last_place(value, digits))


def _rounded(value: float, digits: int, rounding: str) -> Decimal:
    exact = Decimal(repr(float(value)))  # Unlike Decimal(0.03), Decimal(repr(0.03)) is exactly 0.03.
    return exact.quantize(_last_place(value, digits), rounding=rounding) if exact.is_finite() else exact


def _last_place(value: float, digits: int) -> Decimal:
    return Decimal(1).scaleb(Decimal(repr(float(value))).adjusted() - digits + 1)
