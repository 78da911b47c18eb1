"""What an evaluation found: one row for each episode, and metrics with their intervals."""

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
        value: over the episodes that have it; NaN where none has.
        low: lower end of the 95 % bootstrap interval over episodes.
        high: upper end.
        episodes: how many have it.
        unit: of the three; empty for shares and ratios.
        better: ``higher``, ``lower``, or empty where neither is.
    """

    value: float
    low: float
    high: float
    episodes: int
    unit: str = ""
    better: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values, None for what is no number."""
        numbers = {name: _plain(getattr(self, name)) for name in ("value", "low", "high")}
        return {**numbers, "episodes": self.episodes, "unit": self.unit, "better": self.better}


@dataclass(frozen=True)
class Evaluation:
    """How good a policy was in the scenarios of a protocol.

    Attributes:
        protocol: the composed protocol, plain.
        seed: of the scenarios' starts.
        scenarios_sha256: of the table of commands and its seed: equal for every policy under one protocol.
        starts_sha256: of where the episodes began and what was randomised, by test: equal where the task's starts are,
            and then episodes of two policies are pairs.
        episodes: columns by name, (E,) each: numbers, NaN where an episode has none, or texts.
        metrics: by ``group/metric``.
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
        """Return all but the episodes as plain values."""
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
            KeyError: the protocol has no such metric.
        """
        return self.metrics[metric].value


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
