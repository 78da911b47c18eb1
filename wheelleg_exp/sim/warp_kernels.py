"""Warp kernels, each of which replaces a dozen torch kernels; Warp compiles a kernel when it is first launched."""

from typing import Any

import warp as wp

# Do not import annotations from __future__ here, because Warp reads annotations as types, not as strings.


@wp.kernel
def restore(
    ids: wp.array(dtype=wp.int64),
    values: wp.array2d(dtype=wp.float32),
    initial: wp.array(dtype=wp.float32),
    huge: wp.float32,
) -> None:
    """Replace NaN and values of magnitude ``huge`` or more by initial values, in the simulations ``ids``."""
    row, column = wp.tid()
    world = int(ids[row])
    if not wp.abs(values[world, column]) < huge:
        values[world, column] = initial[column]


@wp.kernel
def note_huge(values: wp.array2d(dtype=wp.float32), huge: wp.float32, found: wp.array(dtype=wp.bool)) -> None:
    """Set ``found`` to True for each simulation with a value that is NaN or has the magnitude ``huge`` or more."""
    world = wp.tid()
    for column in range(values.shape[1]):
        if not wp.abs(values[world, column]) < huge:
            found[world] = True


@wp.kernel
def spoil(
    values: wp.array2d(dtype=wp.float32), ids: wp.array(dtype=wp.int64), total: wp.array(dtype=wp.float32)
) -> None:
    """Set ``total[0]`` to NaN if ``values[ids]`` contains NaN or inf."""
    row, column = wp.tid()
    if not wp.isfinite(values[int(ids[row]), column]):
        total[0] = wp.nan


def flat(values: Any) -> Any:
    """Return a two-dimensional Warp array that shares its memory with a float32 tensor (N, ...)."""
    return wp.from_torch(values.view(len(values), -1), dtype=wp.float32)
