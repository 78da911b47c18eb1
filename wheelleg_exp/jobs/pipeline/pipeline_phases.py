"""Phases of a pipeline and their gates: the config options, and whether an evaluation passes a gate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from wheelleg_exp.constraints import Count
from wheelleg_exp.errors import ConfigError, nearest_name

_LEAST_CONTACT = 0.97  # If wheels touch level ground in a smaller share of the steps, the physics steps are too long.


@dataclass(frozen=True)
class Gate:
    """``pipeline.phases.<phase>.gate``: the evaluation that a policy must pass before the next phase.

    Attributes:
        protocol: a protocol of `wheelleg evaluate`; training never sees its scenarios.
        at_least: the smallest accepted value of each metric, by ``group/metric``.
        at_most: the largest accepted value of each metric.
        overrides: changes to the protocol, such as ``protocol.stand.episodes=16``.
        every: iterations between two evaluations during training; null evaluates only after the last iteration.
        passes: consecutive passed evaluations that end the phase before its last iteration.
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
        max_iterations: largest number of iterations in total.
        overrides: further overrides of ``wheelleg train``.
        gate: the gate after the phase; null means that the next phase always starts.
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
        phases: the phases by name, in order; each starts with the policy of the previous one; null removes a phase.
        results: protocol with which the last policy and the reference controller are evaluated at the end; then the
            policy is filmed and exported, and a report is written. Null ends the pipeline after the last phase.
        figures: patterns of the metrics that are printed at the end, such as ``*/survival``; empty prints all.
    """

    name: str
    phases: dict[str, Phase | None]
    results: str | None = None
    figures: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PipelineRoot:
    """The top-level config keys of a training pipeline."""

    pipeline: Pipeline


@dataclass(frozen=True)
class Verdict:
    """The verdict of a gate: the values of its metrics, and the violated bounds in words."""

    passed: bool
    values: dict[str, float | None]
    why: list[str]


def judge(gate: Gate, metrics: Mapping[str, float | None]) -> Verdict:
    """Compare an evaluation's metrics with the bounds that a pipeline phase must meet; NaN and inf meet no bound."""
    bounds = [(name, bound, True) for name, bound in gate.at_least.items()]
    bounds += [(name, bound, False) for name, bound in gate.at_most.items()]
    values, why = {}, []
    for name, bound, least in bounds:
        if name not in metrics:
            message = f"protocol '{gate.protocol}' has no metric '{name}'"
            expected = "one of " + ", ".join(metrics)
            raise ConfigError(message, key="gate", expected=expected, nearest=nearest_name(name, metrics))
        value = values[name] = metrics[name]
        finite = value if value is not None and math.isfinite(value) else None
        if finite is None or (finite < bound if least else finite > bound):
            shown = "not a number" if finite is None else f"{finite:.4g}"
            why.append(f"{name} is {shown}, but must be {'at least' if least else 'at most'} {bound:g}")
    down = [value for name, value in metrics.items() if name.endswith("/wheels_down_share") and value is not None]
    if why and min(down, default=1.0) < _LEAST_CONTACT:
        advice = "before a new training, halve physics_dt and double decimation in the robot's YAML file"
        lifted = "unless the robot jumps or crosses obstacles"
        why.append(f"a wheel is off the ground in {1.0 - min(down):.0%} of the steps: {lifted}, {advice}")
    return Verdict(not why, values, why)
