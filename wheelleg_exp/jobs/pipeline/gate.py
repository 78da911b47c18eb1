"""Whether what an evaluation found passes a gate, and in which words it does not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.jobs.pipeline.options import Gate


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
