"""Result of an evaluation: one row per episode, and metrics with their intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

FORMAT = 1


def plain(value: object) -> object:
    """Return a copy of a nested mapping or list for JSON, in which None replaces NaN and inf."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Figure:
    """One metric with its 95 % bootstrap interval; value and interval are NaN if no episode counts.

    ``unit`` is empty for shares and ratios. ``better`` says which values are better: ``higher``, ``lower``, or empty.
    """

    value: float
    low: float
    high: float
    episodes: int
    unit: str = ""
    better: str = ""

    def as_dict(self) -> dict[str, object]:
        """Return the metric as a dictionary for JSON, in which None replaces NaN and inf."""
        return {key: plain(value) for key, value in vars(self).items()}


@dataclass(frozen=True)
class Evaluation:
    """The result of a policy's evaluation in the tests of an evaluation protocol.

    ``scenarios_sha256`` is the digest of commands and seed: equal for every policy under one protocol.
    ``starts_sha256`` maps each test to a hash of start states and randomised values; with equal hashes, the episodes of
    two evaluations form pairs. ``episodes`` contains columns (E,) of texts, or of numbers that are NaN if missing.
    ``metrics`` are by ``group/metric``. ``about`` describes the robot, the time steps, and the device.
    """

    protocol: Mapping[str, Any]
    seed: int
    scenarios_sha256: str
    starts_sha256: Mapping[str, str]
    episodes: Mapping[str, np.ndarray]
    metrics: Mapping[str, Figure]
    about: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """Return the metrics and properties of an evaluation, without its episodes, as a dictionary for JSON."""
        head = {"format": FORMAT, "protocol": dict(self.protocol), "seed": self.seed}
        digests = {"scenarios_sha256": self.scenarios_sha256, "starts_sha256": dict(self.starts_sha256)}
        metrics = {name: figure.as_dict() for name, figure in self.metrics.items()}
        return {**head, **digests, "about": dict(self.about), "metrics": metrics}

    def value(self, metric: str) -> float:
        """Return the value of a metric. Raise KeyError if the evaluation does not contain the metric."""
        return self.metrics[metric].value
