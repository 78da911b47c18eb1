"""What a config may say of a pipeline."""

from __future__ import annotations

from dataclasses import dataclass, field

from wheelleg_exp.constraints import Count


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
