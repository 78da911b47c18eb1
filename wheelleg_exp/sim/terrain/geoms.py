"""Geoms of a ground: height fields, and boxes for tiles with vertical edges."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from wheelleg_exp.sim.terrain.height_map import Tile

_COLOUR = (0.35, 0.38, 0.42, 1.0)


def add_geom(spec: mujoco.MjSpec, name: str, friction: float, **what: Any) -> None:
    """Add one geom of the ground to a scene's spec."""
    spec.worldbody.add_geom(name=name, friction=[friction, 0.005, 0.0001], rgba=_COLOUR, **what)


def add_box(spec: mujoco.MjSpec, name: str, friction: float, low: npt.ArrayLike, high: npt.ArrayLike) -> None:
    """Add a box between two corners (3,), m."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    add_geom(spec, name, friction, type=mujoco.mjtGeom.mjGEOM_BOX, size=(high - low) / 2, pos=(low + high) / 2)


def add_tile(
    spec: mujoco.MjSpec, name: str, friction: float, tile: Tile, centre: tuple[float, float], size: tuple[float, float]
) -> None:
    """Add a tile as a height field or boxes, which extend below the lowest height by a tenth of the tile's edge.

    Args:
        spec: the scene's spec.
        name: name of the geom, or prefix of the boxes' names.
        friction: friction coefficient.
        tile: the heights.
        centre: centre of the tile, m.
        size: edges of the tile, m.
    """
    heights = tile.heights.astype(float)
    corner = np.array(centre) - np.array(size) / 2
    depth, lowest, highest = 0.1 * min(size), heights.min(), heights.max()
    if lowest == highest:
        add_box(spec, name, friction, (*corner, lowest - depth), (*(corner + size), highest))
    elif tile.boxes:
        cell = np.array(size) / tile.cells
        for number, (i0, i1, j0, j1, top) in enumerate(_boxes(heights)):
            low, high = corner + cell * (i0, j0), corner + cell * (i1, j1)
            add_box(spec, f"{name}/{number}", friction, (*low, lowest - depth), (*high, top))
    else:
        add_field(spec, name, friction, heights, centre, size, depth)


def add_field(
    spec: mujoco.MjSpec,
    name: str,
    friction: float,
    heights: npt.NDArray[np.float64],
    centre: tuple[float, float],
    size: tuple[float, float],
    depth: float,
) -> None:
    """Add a height field that is not level; MuJoCo's rows are along y, and its data is scaled to [0, 1]."""
    lowest, span = heights.min(), np.ptp(heights)
    columns, rows = heights.shape
    spec.add_hfield(
        name=name,
        nrow=rows,
        ncol=columns,
        size=[size[0] / 2, size[1] / 2, span, depth],
        userdata=((heights - lowest) / span).T.ravel(),
    )
    add_geom(spec, name, friction, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=name, pos=(*centre, lowest))


def _boxes(heights: npt.NDArray[np.float64]) -> list[tuple[int, int, int, int, float]]:
    """Return boxes ``(i0, i1, j0, j1, top)`` of cells whose tops are the heights: the smaller of two decompositions.

    One makes boxes of the cells of each height. The other makes boxes of the cells of each height or above, so that
    boxes overlap.
    """
    levels = np.unique(heights)
    apart = [(*box, float(level)) for level in levels for box in _rectangles(heights == level)]
    nested = [(*box, float(level)) for level in levels for box in _rectangles(heights >= level)]
    return min(nested, apart, key=len)


def _rectangles(mask: npt.NDArray[np.bool_]) -> Iterator[tuple[int, int, int, int]]:
    """Yield rectangles of cells that cover the mask: runs along y, extended along x while the run is the same."""
    padded = np.pad(mask, ((0, 1), (1, 1))).astype(np.int8)
    steps = np.diff(padded, axis=1)
    started: dict[tuple[int, int], int] = {}
    for i, row in enumerate(steps):
        runs = set(zip(np.flatnonzero(row == 1).tolist(), np.flatnonzero(row == -1).tolist(), strict=True))
        for run in [run for run in started if run not in runs]:
            yield started.pop(run), i, *run
        for run in sorted(runs - started.keys()):
            started[run] = i
