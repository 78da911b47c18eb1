"""Named ranges, as terms take them from a config."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from wheelleg_exp.errors import ConfigError, nearest_name

Range = Mapping[str, Sequence[float]]


def interval(values: Sequence[float], key: str) -> tuple[float, float]:
    """Return a range as (low, high); ConfigError unless it is two numbers in order."""
    if not isinstance(values, Sequence) or len(values) != 2 or not values[0] <= values[1]:
        raise ConfigError(f"is {values!r}", key=key, expected="[low, high]")
    return float(values[0]), float(values[1])


def bounds(ranges: Range, axes: Sequence[str], key: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Return lows and highs (k,) of named ranges; an axis that is not named is (0, 0).

    Raises:
        ConfigError: an axis is unknown or a range is not two numbers in order.
    """
    for axis, pair in ranges.items():
        if axis not in axes:
            raise ConfigError(
                f"unknown axis '{axis}'", key=key, expected=", ".join(axes), nearest=nearest_name(axis, axes)
            )
        interval(pair, f"{key}.{axis}")
    pairs = torch.tensor([list(ranges.get(axis, (0.0, 0.0))) for axis in axes], dtype=torch.float32)
    return pairs[:, 0], pairs[:, 1]
