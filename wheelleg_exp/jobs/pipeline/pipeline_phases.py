"""Phases of a pipeline and their gates: the config options, and whether an evaluation passes a gate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from wheelleg_exp.constraints import Count
from wheelleg_exp.errors import ConfigError, nearest_name


@dataclass(frozen=True)
class Gate:
    """``pipeline.phases.<phase>.gate``: what a policy must be able to do before the next phase.

    Attributes:
        protocol: the protocol of `wheelleg evaluate` whose scenarios are driven; training never sees them.
        at_least: the least value of each metric, by ``group/metric``.
        at_most: the greatest value of each metric.
        overrides: changes to the protocol, such as ``protocol.stand.episodes=16``.
        every: iterations between two evaluations while it trains; null evaluates behind the last one alone.
        passes: how many evaluations must pass in a row for it to go on before the last iteration.
    """

    protocol: str
    at_least: dict[str, float] = field(default_factory=dict)
    at_most: dict[str, float] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    every: Count | None = None
    passes: Count = 1


@dataclass(frozen=True)
class Phase:
    """``pipeline.phases.<phase>``: one training.

    Attributes:
        task: the task.
        max_iterations: most iterations, in total.
        overrides: further overrides of ``wheelleg train``.
        gate: what it must pass; null lets the next phase begin in any case.
    """

    task: str
    max_iterations: Count
    overrides: list[str] = field(default_factory=list)
    gate: Gate | None = None


@dataclass(frozen=True)
class Pipeline:
    """``pipeline``: phases by name, in order.

    Attributes:
        name: the pipeline's name.
        phases: the phases by name, in order, each begun with the policy of the one before; null removes one.
    """

    name: str
    phases: dict[str, Phase | None]


@dataclass(frozen=True)
class Verdict:
    """What a gate says.

    Attributes:
        passed: whether every bound holds.
        values: the metrics that it asks for.
        why: the bounds that do not hold, in words.
    """

    passed: bool
    values: dict[str, float | None]
    why: list[str]


def judge(gate: Gate, metrics: Mapping[str, float | None]) -> Verdict:
    """Hold metrics against a gate; one that is no number passes none.

    Args:
        gate: the bounds.
        metrics: values by ``group/metric``; None and NaN where no episode had one.

    Raises:
        ConfigError: the protocol has no such metric.
    """
    bounds = [(name, bound, True) for name, bound in gate.at_least.items()]
    bounds += [(name, bound, False) for name, bound in gate.at_most.items()]
    values, why = {}, []
    for name, bound, least in bounds:
        if name not in metrics:
            raise ConfigError(
                f"protocol '{gate.protocol}' has no metric '{name}'",
                key="gate",
                expected="one of " + ", ".join(metrics),
                nearest=nearest_name(name, metrics),
            )
        value = values[name] = metrics[name]
        known = value is not None and math.isfinite(value)
        if not known or (value < bound if least else value > bound):  # type: ignore[operator]
            shown = f"{value:.4g}" if known else "not a number"
            why.append(f"{name} is {shown}, and {'at least' if least else 'at most'} {bound:g} is asked for")
    return Verdict(not why, values, why)


def streak(verdicts: list[bool]) -> int:
    """Return how many of the last verdicts in a row have passed."""
    count = 0
    for passed in reversed(verdicts):
        if not passed:
            break
        count += 1
    return count
