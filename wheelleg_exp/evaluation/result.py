"""Result of an evaluation: one row per episode, and metrics with their intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

FORMAT = 1


@dataclass(frozen=True)
class Figure:
    """One metric.

    Attributes:
        value: over the episodes that have it; NaN if no episode has it.
        low: lower end of the 95 % bootstrap interval over episodes.
        high: upper end.
        episodes: number of episodes that have it.
        unit: unit of the three; empty for shares and ratios.
        better: ``higher``, ``lower``, or empty.
    """

    value: float
    low: float
    high: float
    episodes: int
    unit: str = ""
    better: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the metric for JSON, with None for NaN and inf."""
        numbers = {name: _plain(getattr(self, name)) for name in ("value", "low", "high")}
        return {**numbers, "episodes": self.episodes, "unit": self.unit, "better": self.better}


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation by a protocol.

    Attributes:
        protocol: the composed protocol, plain.
        seed: seed of the scenarios' starts.
        scenarios_sha256: digest of the table of commands and its seed: equal for every policy under one protocol.
        starts_sha256: digest of the start states and randomised values by test. If it is equal, the episodes of two
            policies are pairs.
        episodes: columns by name, (E,) each: numbers, NaN where an episode has none, or texts.
        metrics: metrics by ``group/metric``.
        about: the robot and its profile, armature, time step, device.
    """

    protocol: Mapping[str, Any]
    seed: int
    scenarios_sha256: str
    starts_sha256: Mapping[str, str]
    episodes: Mapping[str, np.ndarray[Any, Any]]
    metrics: Mapping[str, Figure]
    about: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the result without the episodes for JSON."""
        return {
            "format": FORMAT,
            "protocol": dict(self.protocol),
            "seed": self.seed,
            "scenarios_sha256": self.scenarios_sha256,
            "starts_sha256": dict(self.starts_sha256),
            "about": dict(self.about),
            "metrics": {name: figure.as_dict() for name, figure in self.metrics.items()},
        }

    def value(self, metric: str) -> float:
        """Return the value of a metric.

        Raises:
            KeyError: the protocol does not have the metric.
        """
        return self.metrics[metric].value


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
