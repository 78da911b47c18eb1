"""A ground of generated tiles: kind, difficulty, heights, origin, and flat patches of each tile."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, cast

import mujoco
import numpy as np
import torch

from wheelleg_exp import constraints
from wheelleg_exp.constraints import Broken, Count, NonNegative, Positive, Share, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.machine import require_memory
from wheelleg_exp.progress import with_progress
from wheelleg_exp.sim.terrain.relief import HeightMap, Tile, add_box, add_tile
from wheelleg_exp.sim.terrain.sub_terrains import Array, Grid, SubTerrain
from wheelleg_exp.sim.terrain.terrain_base import GROUND, TERRAIN_KEY, TerrainBase

_MARGIN = 0.001  # As in Isaac Lab, 0.001 is added to col / num_cols when a column's sub-terrain is chosen.
ORIGIN_WINDOW = 0.25  # A robot starts at the largest height in the central quarter of a terrain tile's width.
_BYTES = 40  # NumPy, torch and MuJoCo together need 40 bytes per grid square of the ground.


def _some_share(sub_terrains: Mapping[str, constraints.Node | SubTerrain | None]) -> Iterator[Broken]:
    parts = [node for node in sub_terrains.values() if node is not None]
    if not any(node.proportion if isinstance(node, SubTerrain) else node["proportion"] for node in parts):
        yield Broken("sub_terrains", "no sub-terrain has a proportion above 0", "one with a proportion above 0")


@relation(_some_share)
class TerrainGenerator(TerrainBase):
    """Terrain of tiles in rows along x and columns along y, centred on the world's origin.

    With ``curriculum``, all tiles of a column are of one sub-terrain, chosen by the proportions, and the difficulty of
    row i is ``low + (high - low) (i + U(0, 1)) / rows``, with ``exact_levels`` ``low + (high - low) (i + 1) / rows``.
    Otherwise, both are random for each tile.

    Args:
        size: edges of a tile along x and y, m.
        num_rows: number of tiles along x: the levels of a curriculum.
        num_cols: number of tiles along y.
        border_width: width of the level ground at height 0 around all tiles, m.
        horizontal_scale: edge of a cell, m, adjusted to divide the tile.
        vertical_scale: resolution of heights, m.
        curriculum: whether rows are levels.
        difficulty_range: the lowest and the highest difficulty, from 0 to 1.
        sub_terrains: kinds of tiles by name; null removes a kind.
        seed: seed of the ground's random generator; null means the run's seed.
        max_init_terrain_level: highest row in which an environment starts; null means the last row.
        origin_window: edge of a window in the tile's centre, as a share of the tile's edge; its highest point is the
            height of the tile's origin. In Isaac Lab, each kind of tile defines this height, such as 0 for ``Rails``.
        exact_levels: whether all tiles of a row have the same difficulty, and those of the last row the highest.
    """

    def __init__(
        self,
        size: Annotated[Sequence[Positive], constraints.Length(2)],
        num_rows: Count,
        num_cols: Count,
        border_width: NonNegative,
        horizontal_scale: Positive,
        vertical_scale: Positive,
        curriculum: bool,
        difficulty_range: Annotated[Sequence[Share], constraints.Ordered()],
        sub_terrains: Annotated[Mapping[str, constraints.Node | None], constraints.NotEmpty()],
        static_friction: NonNegative,
        dynamic_friction: NonNegative,
        restitution: Share,
        seed: constraints.Seed | None = None,
        max_init_terrain_level: constraints.Natural | None = None,
        origin_window: Share = ORIGIN_WINDOW,
        exact_levels: bool = False,
    ) -> None:
        super().__init__(static_friction, dynamic_friction, restitution)
        self.size = (float(size[0]), float(size[1]))
        self.max_init_terrain_level = max_init_terrain_level
        self.border_width = border_width
        self.difficulty_range = (difficulty_range[0], difficulty_range[1])
        self.num_rows, self.num_cols, self.curriculum = num_rows, num_cols, curriculum
        self.horizontal_scale, self.vertical_scale = horizontal_scale, vertical_scale
        self._origin_window, self._seed, self._exact_levels = origin_window, seed, exact_levels
        self.sub_terrains = {name: cast(SubTerrain, part) for name, part in sub_terrains.items() if part is not None}

    def place(self, num_envs: int, spacing: float, device: torch.device, stream: Callable[[], torch.Generator]) -> None:
        cells = self.size[0] * self.size[1] / self.horizontal_scale**2 * self.num_rows * self.num_cols
        require_memory(int(_BYTES * cells), f"{TERRAIN_KEY}.horizontal_scale", f"{cells:,.0f} cells of the ground")
        patches = self._generate(stream().initial_seed() if self._seed is None else self._seed)
        self._map = HeightMap(self.tiles, self.num_rows, self.size, device)
        self.terrain_origins = torch.as_tensor(self._origins, dtype=torch.float32, device=device)
        self.flat_patches = {n: torch.as_tensor(p, dtype=torch.float32, device=device) for n, p in patches.items()}
        super().place(num_envs, spacing, device, stream)

    def _generate(self, seed: int) -> Mapping[str, Array]:
        """Make the tiles, equal for equal seeds; return P flat patches per tile by name, m, (rows, cols, P, 3)."""
        rng, shape = np.random.default_rng(seed), (self.num_rows, self.num_cols)
        names, parts = list(self.sub_terrains), list(self.sub_terrains.values())
        self.kinds, self.difficulties = np.zeros(shape, dtype=np.int64), np.zeros(shape)
        self._origins = np.zeros((*shape, 3))
        rows, cols = ((np.arange(n) + 0.5 - n / 2) * edge for n, edge in zip(shape, self.size, strict=True))
        self._origins[..., :2] = np.stack(np.meshgrid(rows, cols, indexing="ij"), axis=-1)
        # If a tile's sub-terrain lacks flat patches that another sub-terrain defines, use the tile's origin instead.
        counts: dict[str, int] = {}
        for kind_name, own in self.sub_terrains.items():
            for patch, wanted in own.flat_patches.items():
                if counts.setdefault(patch, wanted.num_patches) != wanted.num_patches:
                    found = f"{counts[patch]} patches on another sub-terrain and {wanted.num_patches} here"
                    key = f"{TERRAIN_KEY}.sub_terrains.{kind_name}.flat_patches.{patch}.num_patches"
                    expected = "the same number on all sub-terrains"
                    raise ConfigError(f"'{patch}' has {found}", key=key, expected=expected)
        patches = {name: np.zeros((*shape, count, 3)) for name, count in counts.items()}
        tiles: dict[tuple[int, int], Tile] = {}
        # As in Isaac Lab, a terrain with a curriculum is generated column by column, else row by row.
        order = list(np.ndindex(shape)) if not self.curriculum else [(r, c) for c, r in np.ndindex(shape[::-1])]
        for row, col in with_progress("making tiles", order):
            kind, difficulty = self._chosen(row, col, rng)
            part, key = parts[kind], f"{TERRAIN_KEY}.sub_terrains.{names[kind]}"
            tile = self._tile(part, difficulty, rng, key)
            self.kinds[row, col], self.difficulties[row, col], tiles[row, col] = kind, difficulty, tile
            # The height of a tile's origin is the largest height in a window at the tile's centre.
            reaches = ((count, max(0.5, self._origin_window * count / 2)) for count in tile.heights.shape)
            window = tuple(slice(math.floor(n / 2 - reach), math.ceil(n / 2 + reach)) for n, reach in reaches)
            self._origins[row, col, 2] = float(tile.heights[window].max())
            alone = HeightMap([tile], 1, self.size, torch.device("cpu"))
            for places in patches.values():
                places[row, col] = self._origins[row, col]
            origin = self._origins[row, col] * (0.0, 0.0, 1.0)
            for name, wanted in part.flat_patches.items():
                place = f"{key}.flat_patches.{name}"
                patches[name][row, col] += wanted.find(alone.heights_at, origin, self.size, rng, place)
        self.tiles = [tiles[index] for index in np.ndindex(shape)]
        return patches

    def _chosen(self, row: int, col: int, rng: np.random.Generator) -> tuple[int, float]:
        """Return kind and difficulty of a tile: by column and row with a curriculum, otherwise random."""
        shares = np.array([part.proportion for part in self.sub_terrains.values()])
        shares = shares / shares.sum()
        low, high = self.difficulty_range
        if not self.curriculum:
            return int(rng.choice(len(shares), p=shares)), float(rng.uniform(low, high))
        beyond = np.flatnonzero(col / self.num_cols + _MARGIN < np.cumsum(shares))
        kind = int(beyond[0]) if len(beyond) else len(shares) - 1
        within = 1.0 if self._exact_levels else rng.uniform()
        return kind, float(low + (high - low) * (row + within) / self.num_rows)

    def _tile(self, part: SubTerrain, difficulty: float, rng: np.random.Generator, key: str) -> Tile:
        scale, size = part.horizontal_scale or self.horizontal_scale, self.size
        cells = [max(1, round(edge / scale)) for edge in size]
        half = (size[0] / 2 - part.border_width, size[1] / 2 - part.border_width)
        if min(half) <= 0:
            message = "the flat borders cover the whole terrain tile"
            expected = f"less than half a tile's edge, {min(size) / 2:g}"
            raise ConfigError(message, key=f"{key}.border_width", expected=expected)
        pairs = list(zip(cells, size, strict=True))
        x, y = (np.linspace(-edge / 2, edge / 2, count + 1) for count, edge in pairs)
        if part.boxes:
            x, y = ((np.arange(count) + 0.5) * edge / count - edge / 2 for count, edge in pairs)
        grid = Grid(x[:, None], y[None, :], half)
        heights = np.broadcast_to(part.heights(difficulty, grid, rng), (len(x), len(y)))
        heights = np.where(grid.to_edge >= 0, heights, 0.0) if part.border_width else heights
        return Tile((np.rint(heights / self.vertical_scale) * self.vertical_scale).astype(np.float32), part.boxes)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        for number, tile in with_progress("laying tiles", list(enumerate(self.tiles))):
            row, col = divmod(number, self.num_cols)
            x, y, _ = self._origins[row, col]
            add_tile(spec, f"{GROUND}/{row}_{col}", self.dynamic_friction, tile, (x, y), self.size)
        x, y = (self.size[0] * self.num_rows / 2, self.size[1] * self.num_cols / 2)
        width, depth = self.border_width, 0.1 * min(self.size)
        sides = ((-x - width, x + width, y, y + width), (-x - width, x + width, -y - width, -y))
        ends = ((x, x + width, -y, y), (-x - width, -x, -y, y))
        for number, (x0, x1, y0, y1) in enumerate((*sides, *ends) if width else ()):
            name = f"{GROUND}/border/{number}"
            add_box(spec, name, self.dynamic_friction, (x0, y0, -depth), (x1, y1, 0.0))

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        return self._map.height_at(xy)
