"""Named ranges, as terms take them from a config."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from wheelleg_exp.errors import ConfigError, nearest_name

Range = Mapping[str, Sequence[float]]


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
        if len(pair) != 2 or pair[0] > pair[1]:
            raise ConfigError(f"range of '{axis}' is {list(pair)}", key=key, expected="[low, high]")
    pairs = torch.tensor([list(ranges.get(axis, (0.0, 0.0))) for axis in axes], dtype=torch.float32)
    return pairs[:, 0], pairs[:, 1]
