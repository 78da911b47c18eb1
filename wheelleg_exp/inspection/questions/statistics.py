"""Statistics of one number over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


@dataclass(frozen=True)
class Moment:
    """When something was: control step, simulated time in s, training iteration, environment; None where unknown."""

    step: int | None
    time_s: float | None
    iteration: int | None = None
    env_id: int | None = None


@dataclass(frozen=True)
class Statistics:
    """What one number was like; all of it over the finite values, None when there are none.

    Attributes:
        count: how many values, whether finite or not.
        nan, infinite: how many of them are no number, and how many infinite.
        mean, std, rms: mean, standard deviation (over n), root mean square.
        minimum, maximum: the extremes.
        quantiles: values by share, interpolated linearly between the two nearest.
        minimum_at, maximum_at: when the extremes were first reached.
        first_at, last_at: the moments of the first and the last value, whatever it is.
    """

    count: int
    nan: int
    infinite: int
    mean: float | None
    std: float | None
    rms: float | None
    minimum: float | None
    maximum: float | None
    quantiles: dict[float, float]
    minimum_at: Moment | None
    maximum_at: Moment | None
    first_at: Moment | None
    last_at: Moment | None

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as a plain mapping."""
        return asdict(self)


def statistics(values: NDArray[np.float64], at: Callable[[int], Moment] | None = None) -> Statistics:
    """Return the statistics of ``values`` (n,); ``at`` tells when a row was."""
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    kept = values[finite]
    nan = int(np.isnan(values).sum())
    counts = {"count": len(values), "nan": nan, "infinite": len(values) - len(kept) - nan}
    first, last = (at(0), at(len(values) - 1)) if at and len(values) else (None, None)
    if not len(kept):
        nothing = dict.fromkeys(("mean", "std", "rms", "minimum", "maximum", "minimum_at", "maximum_at"))
        return Statistics(**counts, **nothing, quantiles={}, first_at=first, last_at=last)  # type: ignore[arg-type]
    places = np.flatnonzero(finite)
    low, high = places[np.argmin(kept)], places[np.argmax(kept)]
    with np.errstate(over="ignore", invalid="ignore"):  # numbers near the largest there are
        mean, std, rms = float(kept.mean()), float(kept.std()), float(np.sqrt(np.mean(kept**2)))
    return Statistics(
        **counts,
        mean=mean,
        std=std,
        rms=rms,
        minimum=float(values[low]),
        maximum=float(values[high]),
        quantiles=dict(zip(QUANTILES, np.quantile(kept, QUANTILES).tolist(), strict=True)),
        minimum_at=at(int(low)) if at else None,
        maximum_at=at(int(high)) if at else None,
        first_at=first,
        last_at=last,
    )
