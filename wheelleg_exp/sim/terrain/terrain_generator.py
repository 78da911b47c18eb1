"""A ground of generated tiles, and the geoms of tiles: height fields, or boxes for tiles with vertical edges."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, cast

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from wheelleg_exp import constraints
from wheelleg_exp.constraints import Broken, Count, NonNegative, Positive, Share, relation
from wheelleg_exp.machine import require_memory
from wheelleg_exp.progress import with_progress
from wheelleg_exp.sim.terrain.relief import HeightMap, Layout, Tile, make_relief
from wheelleg_exp.sim.terrain.sub_terrains import SubTerrain
from wheelleg_exp.sim.terrain.terrain_base import GROUND, TERRAIN_KEY, TerrainBase

_COLOUR = (0.35, 0.38, 0.42, 1.0)


def add_geom(spec: mujoco.MjSpec, name: str, friction: float, **what: Any) -> None:
    """Add one of the ground's geoms to the scene's MuJoCo spec."""
    spec.worldbody.add_geom(name=name, friction=[friction, 0.005, 0.0001], rgba=_COLOUR, **what)


def add_box(spec: mujoco.MjSpec, name: str, friction: float, low: npt.ArrayLike, high: npt.ArrayLike) -> None:
    """Add a box between two corners (3,), m, to the ground."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    add_geom(spec, name, friction, type=mujoco.mjtGeom.mjGEOM_BOX, size=(high - low) / 2, pos=(low + high) / 2)


def add_tile(
    spec: mujoco.MjSpec, name: str, friction: float, tile: Tile, centre: tuple[float, float], size: tuple[float, float]
) -> None:
    """Add a terrain tile as a height field or boxes, down to a tenth of the tile's edge below the tile's lowest height.

    If the tile has several boxes, their names are ``name/0``, ``name/1``, and so on; ``centre`` and ``size`` are in m.
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


ORIGIN_WINDOW = 0.25  # A robot starts at the largest height in the central quarter of a terrain tile's width.
_BYTES = 40  # NumPy, torch and MuJoCo together need 40 bytes per grid square of the ground.


def _some_share(given: Mapping[str, Any]) -> Iterator[Broken]:
    parts = [node for node in given["sub_terrains"].values() if node is not None]
    if not any((node["proportion"] if isinstance(node, Mapping) else node.proportion) for node in parts):
        yield Broken("sub_terrains", "no sub-terrain has a proportion above 0", "one with a proportion above 0")


@relation(_some_share)
class TerrainGenerator(TerrainBase):
    """Terrain of tiles in rows along x and columns along y, centred on the world's origin.

    With ``curriculum``, all tiles of a column are of one sub-terrain, chosen by the sub-terrains' proportions. With
    ``curriculum``, the difficulty of row i is ``low + (high - low) (i + U(0, 1)) / rows``. Without ``curriculum``, the
    sub-terrain and the difficulty of each tile are random.

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
    ) -> None:
        super().__init__(static_friction, dynamic_friction, restitution)
        self.size = (float(size[0]), float(size[1]))
        self.max_init_terrain_level = max_init_terrain_level
        self.border_width = border_width
        self.difficulty_range = (difficulty_range[0], difficulty_range[1])
        self._seed = seed
        self._cells = (size[0] / horizontal_scale) * (size[1] / horizontal_scale) * num_rows * num_cols
        self.layout = Layout(
            size=self.size,
            num_rows=num_rows,
            num_cols=num_cols,
            horizontal_scale=horizontal_scale,
            vertical_scale=vertical_scale,
            curriculum=curriculum,
            difficulty_range=self.difficulty_range,
            origin_window=origin_window,
            sub_terrains={name: cast(SubTerrain, part) for name, part in sub_terrains.items() if part is not None},
        )

    def place(self, num_envs: int, spacing: float, device: torch.device, stream: Callable[[], torch.Generator]) -> None:
        key = f"{TERRAIN_KEY}.horizontal_scale"
        require_memory(int(_BYTES * self._cells), key, f"{self._cells:,.0f} cells of the ground")
        self.layout = replace(self.layout, seed=stream().initial_seed() if self._seed is None else self._seed)
        self.relief = make_relief(self.layout)
        self._map = HeightMap(self.relief.tiles, self.layout.num_rows, self.size, device)
        self.terrain_origins = torch.as_tensor(self.relief.origins, dtype=torch.float32, device=device)
        patches = self.relief.patches.items()
        self.flat_patches = {n: torch.as_tensor(p, dtype=torch.float32, device=device) for n, p in patches}
        super().place(num_envs, spacing, device, stream)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        tiles = list(enumerate(zip(self.relief.tiles, self.relief.origins.reshape(-1, 3), strict=True)))
        for number, (tile, origin) in with_progress("laying tiles", tiles):
            row, col = divmod(number, self.layout.num_cols)
            name = f"{GROUND}/{row}_{col}"
            add_tile(spec, name, self.dynamic_friction, tile, (origin[0], origin[1]), self.size)
        x, y = (self.size[0] * self.layout.num_rows / 2, self.size[1] * self.layout.num_cols / 2)
        width, depth = self.border_width, 0.1 * min(self.size)
        sides = ((-x - width, x + width, y, y + width), (-x - width, x + width, -y - width, -y))
        ends = ((x, x + width, -y, y), (-x - width, -x, -y, y))
        for number, (x0, x1, y0, y1) in enumerate((*sides, *ends) if width else ()):
            name = f"{GROUND}/border/{number}"
            add_box(spec, name, self.dynamic_friction, (x0, y0, -depth), (x1, y1, 0.0))

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        return self._map.height_at(xy)
