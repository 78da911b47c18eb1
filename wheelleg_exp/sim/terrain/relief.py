"""Generation of a ground: kind, difficulty, heights, origin and flat patches of each tile; height map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.progress import with_progress
from wheelleg_exp.sim.terrain.sub_terrains import Array, Grid, SubTerrain
from wheelleg_exp.sim.terrain.terrain_base import TERRAIN_KEY


@dataclass(frozen=True)
class Tile:
    """The heights of one terrain tile, m; the array's first index is along x, the second index along y.

    If ``boxes`` is false, ``heights`` (nx + 1, ny + 1) are the heights at the corners of the tile's grid squares. If
    ``boxes`` is true, each grid square is the level top of a box, and ``heights`` (nx, ny) has one height per square.
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

    As in MuJoCo's height fields, the surface in a cell between four corners consists of two triangles. The common
    edge of a cell's two triangles joins the corner with the lowest x and y and the corner with the highest x and y.
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


_MARGIN = 0.001  # As in Isaac Lab, 0.001 is added to col / num_cols when a column's sub-terrain is chosen.


@dataclass(frozen=True)
class Layout:
    """The arguments of ``TerrainGenerator`` that determine the shape of the ground."""

    size: tuple[float, float]
    num_rows: int
    num_cols: int
    horizontal_scale: float
    vertical_scale: float
    curriculum: bool
    difficulty_range: tuple[float, float]
    origin_window: float
    sub_terrains: Mapping[str, SubTerrain]
    seed: int = 0


@dataclass(frozen=True)
class Relief:
    """A generated ground, whose coordinates are relative to the ground's centre.

    ``tiles`` lists the tiles row by row, ``kinds`` (rows, cols) are the indices of the tiles' sub-terrains, and
    ``origins`` (rows, cols, 3) are the tiles' origins, m. ``patches`` maps each name to the positions of P flat patches
    per tile, m, (rows, cols, P, 3).
    """

    tiles: Sequence[Tile]
    kinds: npt.NDArray[np.int64]
    difficulties: Array
    origins: Array
    patches: Mapping[str, Array]


def make_relief(layout: Layout) -> Relief:
    """Generate the ground; equal arguments give equal grounds. Raise ConfigError if a terrain tile cannot be made."""
    rng = np.random.default_rng(layout.seed)
    shape = (layout.num_rows, layout.num_cols)
    names, parts = list(layout.sub_terrains), list(layout.sub_terrains.values())
    kinds, difficulties, origins = np.zeros(shape, dtype=np.int64), np.zeros(shape), np.zeros((*shape, 3))
    rows = (np.arange(layout.num_rows) + 0.5 - layout.num_rows / 2) * layout.size[0]
    cols = (np.arange(layout.num_cols) + 0.5 - layout.num_cols / 2) * layout.size[1]
    origins[..., :2] = np.stack(np.meshgrid(rows, cols, indexing="ij"), axis=-1)
    # If a tile's sub-terrain lacks flat patches that another sub-terrain defines, use the tile's origin instead.
    counts: dict[str, int] = {}
    for kind_name, own in layout.sub_terrains.items():
        for patch, wanted in own.flat_patches.items():
            if counts.setdefault(patch, wanted.num_patches) != wanted.num_patches:
                message = f"'{patch}' has {counts[patch]} patches on another sub-terrain and {wanted.num_patches} here"
                key = f"{TERRAIN_KEY}.sub_terrains.{kind_name}.flat_patches.{patch}.num_patches"
                raise ConfigError(message, key=key, expected="the same number on all sub-terrains")
    patches = {name: np.zeros((*shape, count, 3)) for name, count in counts.items()}
    tiles: dict[tuple[int, int], Tile] = {}
    # As in Isaac Lab, a terrain with a curriculum is generated column by column, else row by row.
    order = list(np.ndindex(shape)) if not layout.curriculum else [(r, c) for c, r in np.ndindex(shape[::-1])]
    for row, col in with_progress("making tiles", order):
        kind, difficulty = _chosen(layout, row, col, rng)
        part, key = parts[kind], f"{TERRAIN_KEY}.sub_terrains.{names[kind]}"
        tile = _tile(layout, part, difficulty, rng, key)
        kinds[row, col], difficulties[row, col], tiles[row, col] = kind, difficulty, tile
        # The height of a tile's origin is the largest height in a window at the tile's centre.
        windows = []
        for count in tile.heights.shape:
            reach = max(0.5, layout.origin_window * count / 2)
            windows.append(slice(int(np.floor(count / 2 - reach)), int(np.ceil(count / 2 + reach))))
        origins[row, col, 2] = float(tile.heights[tuple(windows)].max())
        alone = HeightMap([tile], 1, layout.size, torch.device("cpu"))
        origin = np.array([0.0, 0.0, origins[row, col, 2]])
        for name in patches:
            patches[name][row, col] = origins[row, col]
        for name, wanted in part.flat_patches.items():
            key_of_patches = f"{key}.flat_patches.{name}"
            patches[name][row, col] += wanted.find(alone.heights_at, origin, layout.size, rng, key_of_patches)
    return Relief([tiles[index] for index in np.ndindex(shape)], kinds, difficulties, origins, patches)


def _chosen(layout: Layout, row: int, col: int, rng: np.random.Generator) -> tuple[int, float]:
    """Return kind and difficulty of a tile: by column and row with a curriculum, otherwise random."""
    shares = np.array([part.proportion for part in layout.sub_terrains.values()])
    shares = shares / shares.sum()
    low, high = layout.difficulty_range
    if not layout.curriculum:
        return int(rng.choice(len(shares), p=shares)), float(rng.uniform(low, high))
    beyond = np.flatnonzero(col / layout.num_cols + _MARGIN < np.cumsum(shares))
    kind = int(beyond[0]) if len(beyond) else len(shares) - 1
    return kind, float(low + (high - low) * (row + rng.uniform()) / layout.num_rows)


def _tile(layout: Layout, part: SubTerrain, difficulty: float, rng: np.random.Generator, key: str) -> Tile:
    scale, size = part.horizontal_scale or layout.horizontal_scale, layout.size
    cells = [max(1, round(edge / scale)) for edge in size]
    half = (size[0] / 2 - part.border_width, size[1] / 2 - part.border_width)
    if min(half) <= 0:
        expected = f"less than half a tile's edge, {min(size) / 2:g}"
        raise ConfigError("the flat borders cover the whole terrain tile", key=f"{key}.border_width", expected=expected)
    pairs = list(zip(cells, size, strict=True))
    x, y = (np.linspace(-edge / 2, edge / 2, count + 1) for count, edge in pairs)
    if part.boxes:
        x, y = ((np.arange(count) + 0.5) * edge / count - edge / 2 for count, edge in pairs)
    grid = Grid(x[:, None], y[None, :], half)
    heights = np.broadcast_to(part.heights(difficulty, grid, rng), (len(x), len(y)))
    heights = np.where(grid.to_edge >= 0, heights, 0.0) if part.border_width else heights
    return Tile((np.rint(heights / layout.vertical_scale) * layout.vertical_scale).astype(np.float32), part.boxes)
