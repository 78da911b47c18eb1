"""Terrain tiles: their heights, the height map of several tiles, and their geoms: height fields, or boxes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from wheelleg_exp.sim.terrain.sub_terrains import Array
from wheelleg_exp.sim.terrain.terrain_base import add_geom


@dataclass(frozen=True)
class Tile:
    """The heights of one terrain tile, m; the array's first index is along x, the second index along y.

    ``heights`` are at the corners of the grid squares, (nx + 1, ny + 1), or with ``boxes``, of their tops, (nx, ny).
    """

    heights: npt.NDArray[np.float32]
    boxes: bool

    @property
    def cells(self) -> tuple[int, int]:
        """The numbers of grid squares of a tile along x and y."""
        nx, ny = self.heights.shape
        return (nx, ny) if self.boxes else (nx - 1, ny - 1)


class HeightMap:
    """The layout of terrain tiles in rows along x and columns along y, centred on the world's origin; ``size`` is in m.

    As in MuJoCo's height fields, a cell is two triangles, split at the diagonal from the lowest x and y to the highest.
    """

    def __init__(self, tiles: Sequence[Tile], rows: int, size: Sequence[float], device: torch.device) -> None:
        flat = np.concatenate([tile.heights.ravel() for tile in tiles])
        starts = np.cumsum([0, *(tile.heights.size for tile in tiles[:-1])])
        self._heights = torch.as_tensor(flat, device=device)
        self._starts = torch.as_tensor(starts, device=device)
        self._cells = torch.tensor([tile.cells for tile in tiles], device=device)
        self._slanted = torch.tensor([not tile.boxes for tile in tiles], device=device).long()
        self._counts = torch.tensor([rows, len(tiles) // rows], device=device)
        self._size = torch.tensor(list(size), device=device)

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        """Return the ground's heights (...) at points (..., 2), m; 0 outside of the terrain tiles and for NaN."""
        place = (xy / self._size.to(xy) + self._counts / 2).nan_to_num(nan=-1.0)  # -1 is outside
        tile = place.floor()
        inside = ((place >= 0) & (place <= self._counts)).all(dim=-1)
        tile = tile.clamp(min=0).minimum(self._counts - 1)
        number = tile[..., 0].long() * self._counts[1] + tile[..., 1].long()
        cells = self._cells[number]
        within = (place - tile) * cells
        cell = within.floor().clamp(min=0).minimum(cells - 1)
        u, v = (within - cell).clamp(0, 1).unbind(dim=-1)
        slanted = self._slanted[number]
        along_x = cells[..., 1] + slanted  # In ``_heights``, grid neighbours along x are ``along_x`` entries apart.
        first = self._starts[number] + cell[..., 0].long() * along_x + cell[..., 1].long()
        a, b = self._heights[first], self._heights[first + slanted * along_x]
        c, d = self._heights[first + slanted], self._heights[first + slanted * (along_x + 1)]
        height = a + torch.where(u >= v, (b - a) * u + (d - b) * v, (c - a) * v + (d - c) * u)
        return torch.where(inside, height, 0.0).to(xy.dtype)

    def heights_at(self, points: Array) -> Array:
        """Return the ground's heights (...), m, at points (..., 2), as arrays; the height map must be on the CPU."""
        return self.height_at(torch.from_numpy(points)).numpy()


def add_box(spec: mujoco.MjSpec, name: str, friction: float, low: npt.ArrayLike, high: npt.ArrayLike) -> None:
    """Add a box between two corners (3,), m, to the ground."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    add_geom(spec, name, friction, type=mujoco.mjtGeom.mjGEOM_BOX, size=(high - low) / 2, pos=(low + high) / 2)


def add_tile(
    spec: mujoco.MjSpec, name: str, friction: float, tile: Tile, centre: tuple[float, float], size: tuple[float, float]
) -> None:
    """Add a terrain tile as a height field or boxes, down to a tenth of the tile's edge below the tile's lowest height.

    Several boxes are named ``name/0``, ``name/1``, and so on; ``centre`` and ``size`` are in m.
    """
    heights = tile.heights.astype(float)
    corner = np.array(centre) - np.array(size) / 2
    depth, lowest, highest = 0.1 * min(size), heights.min(), heights.max()
    if lowest == highest:
        add_box(spec, name, friction, (*corner, lowest - depth), (*(corner + size), highest))
    elif tile.boxes:
        cell = np.array(size) / tile.cells
        # Represent the heights by boxes side by side or by nested boxes, whichever are fewer.
        levels = np.unique(heights)
        apart = [(*box, float(level)) for level in levels for box in _rectangles(heights == level)]
        nested = [(*box, float(level)) for level in levels for box in _rectangles(heights >= level)]
        for number, (i0, i1, j0, j1, top) in enumerate(nested if len(nested) <= len(apart) else apart):
            low, high = corner + cell * (i0, j0), corner + cell * (i1, j1)
            add_box(spec, f"{name}/{number}", friction, (*low, lowest - depth), (*high, top))
    else:
        # The heights in a MuJoCo height field are from 0 to 1, and its rows run along y.
        span, (columns, rows) = highest - lowest, heights.shape
        data = ((heights - lowest) / span).T.ravel()
        spec.add_hfield(name=name, nrow=rows, ncol=columns, size=[size[0] / 2, size[1] / 2, span, depth], userdata=data)
        add_geom(spec, name, friction, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=name, pos=(*centre, lowest))


def _rectangles(mask: npt.NDArray[np.bool_]) -> Iterator[tuple[int, int, int, int]]:
    """Yield rectangles of cells that cover the mask: runs along y, extended along x while the run is the same."""
    steps = np.diff(np.pad(mask, ((0, 1), (1, 1))).astype(np.int8), axis=1)
    started: dict[tuple[int, int], int] = {}
    for i, row in enumerate(steps):
        runs = set(zip(np.flatnonzero(row == 1).tolist(), np.flatnonzero(row == -1).tolist(), strict=True))
        for run in [run for run in started if run not in runs]:
            yield started.pop(run), i, *run
        for run in sorted(runs - started.keys()):
            started[run] = i
