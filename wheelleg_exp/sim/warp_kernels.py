"""Warp kernels that do in one launch what torch needs a dozen launches for; Warp compiles them at the first launch."""

from typing import Any

import warp as wp

# No `from __future__ import annotations`: Warp reads the types.


@wp.kernel
def restore(
    ids: wp.array(dtype=wp.int64),
    values: wp.array2d(dtype=wp.float32),
    initial: wp.array(dtype=wp.float32),
    huge: wp.float32,
) -> None:
    """Set numbers of some simulations to what they were at first, where they are as large as ``huge``, or none."""
    row, column = wp.tid()
    world = int(ids[row])
    if not wp.abs(values[world, column]) < huge:
        values[world, column] = initial[column]


@wp.kernel
def note_huge(values: wp.array2d(dtype=wp.float32), huge: wp.float32, found: wp.array(dtype=wp.bool)) -> None:
    """Note simulations one of whose numbers is as large as ``huge``, or none."""
    world = wp.tid()
    for column in range(values.shape[1]):
        if not wp.abs(values[world, column]) < huge:
            found[world] = True


@wp.kernel
def spoil(
    values: wp.array2d(dtype=wp.float32), ids: wp.array(dtype=wp.int64), total: wp.array(dtype=wp.float32)
) -> None:
    """Make a total no number where one of some simulations' numbers is not finite."""
    row, column = wp.tid()
    if not wp.isfinite(values[int(ids[row]), column]):
        total[0] = wp.nan


def flat(values: Any) -> Any:
    """Return a live two-dimensional array for Warp of a float32 tensor (N, ...)."""
    return wp.from_torch(values.view(len(values), -1), dtype=wp.float32)
