"""Kinds of terrain tiles: level, rough, sloped, and stepped; and the flat places on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from wheelleg_exp.constraints import (
    Bounds,
    Count,
    Interval,
    NonNegative,
    NonNegativeInterval,
    Positive,
    PositiveInterval,
)
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state import Kept

Array = npt.NDArray[np.float64]
_POINTS = 10  # on each ring around a place, as in Isaac Lab
_ROUNDS = 1000


@dataclass(kw_only=True)
class FlatPatches(Kept):
    """Which places of a tile are taken: those around which the ground is level, drawn until there are enough.

    The height of a place is that of its middle. The ranges are seen from the tile's origin, and cut to the tile.

    Args:
        num_patches: how many a tile, P.
        patch_radius: radius of the ring, m, or of several, on which the ground is looked at.
        max_height_diff: greatest difference of heights on a place, m.
        x_range: m.
        y_range: m.
        z_range: lowest and highest point of a place, m.
    """

    num_patches: Count
    patch_radius: Positive | Sequence[Positive]
    max_height_diff: NonNegative
    x_range: Bounds = (-np.inf, np.inf)
    y_range: Bounds = (-np.inf, np.inf)
    z_range: Bounds = (-np.inf, np.inf)

    def find(
        self,
        height_at: Callable[[Array], Array],
        origin: Array,
        size: Sequence[float],
        rng: np.random.Generator,
        key: str,
    ) -> Array:
        """Return places (P, 3) as seen from the tile's origin, m.

        Args:
            height_at: heights (...) at points (..., 2) of the tile, whose centre is 0.
            origin: the tile's origin (3,).
            size: edges of the tile.
            rng: the ground's source of chance.
            key: the config key of this, for the message.

        Raises:
            ConfigError: the tile is nowhere flat enough.
        """
        low, high = np.transpose([self._bounds(axis, origin, size) for axis in range(2)])
        radii = np.atleast_1d(np.asarray(self.patch_radius, dtype=float))
        angles = np.linspace(0.0, 2 * np.pi, _POINTS, endpoint=False)
        ring = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        offsets = np.concatenate((np.zeros((1, 2)), (radii[:, None, None] * ring).reshape(-1, 2)))
        found = np.zeros((0, 3))
        for _ in range(_ROUNDS):
            places = rng.uniform(low, high, (self.num_patches, 2))
            heights = height_at(places[:, None] + offsets) - origin[2]
            fits = (heights >= self.z_range[0]) & (heights <= self.z_range[1])
            flat = fits.all(axis=1) & (np.ptp(heights, axis=1) <= self.max_height_diff + 1e-9)
            found = np.concatenate((found, np.column_stack((places - origin[:2], heights[:, 0]))[flat]))
            if len(found) >= self.num_patches:
                return found[: self.num_patches]
        raise ConfigError(
            f"{len(found)} of {self.num_patches} flat places were found in {_ROUNDS * self.num_patches:,} tries",
            key=key,
            expected="a smaller patch_radius, a larger max_height_diff or wider ranges",
        )

    def _bounds(self, axis: int, origin: Array, size: Sequence[float]) -> tuple[float, float]:
        low, high = (self.x_range, self.y_range)[axis]
        half = size[axis] / 2
        return max(low + origin[axis], -half), max(min(high + origin[axis], half), max(low + origin[axis], -half))


# The annotations here are values and no text, because dataclasses in other modules inherit the fields.


EDGE = 1e-9  # m: a point on an edge counts as inside, also after rounding


@dataclass(frozen=True)
class Grid:
    """Where the heights of a tile are wanted, as seen from its centre.

    Attributes:
        x: m, (nx, 1), rising.
        y: m, (1, ny), rising.
        half: half edges of what is to be filled, m; the tile's own flat rim lies outside.
    """

    x: Array
    y: Array
    half: tuple[float, float]

    @property
    def to_edge(self) -> Array:
        """How far a point lies inside the nearest edge, m, (nx, ny)."""
        return np.minimum(self.half[0] - np.abs(self.x), self.half[1] - np.abs(self.y)) + EDGE

    @property
    def from_centre(self) -> Array:
        """The larger of the distances along x and y from the centre, m, (nx, ny)."""
        return np.maximum(np.abs(self.x), np.abs(self.y)) - EDGE

    def is_within(self, width: float) -> npt.NDArray[np.bool_]:
        """Return which points lie on a square of that width in the middle, (nx, ny)."""
        return self.from_centre <= width / 2


@dataclass(kw_only=True)
class SubTerrain(Kept):
    """A kind of tile: one YAML node under ``sub_terrains``, this package's or a user's own.

    A subclass returns heights. ``boxes`` says what becomes of them: boxes with upright edges, of which every single
    one costs all environments a little; or a height field, which costs those alone that stand on it, and whose edges
    are slopes one cell wide.

    Args:
        proportion: share of the tiles, in proportion to the others'.
        border_width: flat rim at height 0 inside the tile, m.
        horizontal_scale: edge of a cell, m; null is the generator's.
        flat_patches: places to be found on each tile, by name.
        boxes: whether the heights are those of cells and become boxes, or of corners and become a height field.
    """

    proportion: NonNegative
    border_width: NonNegative = 0.0
    horizontal_scale: Positive | None = None
    flat_patches: Mapping[str, FlatPatches] = field(default_factory=dict)
    boxes: bool = False

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the heights over a grid, m, (nx, ny); the same for the same arguments.

        Args:
            difficulty: 0 is the easiest, 1 the hardest.
            grid: where.
            rng: the ground's only source of chance.
        """
        raise NotImplementedError


def at(difficulty: float, interval: Any) -> float:
    """Return the value of a range ``[easiest, hardest]`` at a difficulty."""
    low, high = interval
    return float(low + difficulty * (high - low))


@dataclass(kw_only=True)
class RandomUniform(SubTerrain):
    """Heights drawn from equal steps within a range, linear between the points; difficulty changes nothing.

    Args:
        noise_range: lowest and highest, m.
        noise_step: between two heights, m.
        downsampled_scale: distance between the drawn points, m; null is the edge of a cell.
    """

    noise_range: Interval
    noise_step: Positive
    downsampled_scale: Positive | None = None

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the noise."""
        del difficulty
        low, high = self.noise_range
        steps = int(np.floor((high - low) / self.noise_step + 1e-9))
        return _between(
            grid,
            self.downsampled_scale,
            lambda shape: low + self.noise_step * rng.integers(steps + 1, size=shape).astype(float),
        )


@dataclass(kw_only=True)
class UniformNoise(SubTerrain):
    """Heights drawn from U(-a, a), linear between the points; the amplitude a grows with the difficulty.

    Args:
        amplitude_range: a of the easiest and of the hardest, m.
        downsampled_scale: distance between the drawn points, m; null is the edge of a cell.
        platform_width: edge of the level square in the middle, m.
    """

    amplitude_range: NonNegativeInterval
    downsampled_scale: Positive | None = None
    platform_width: NonNegative = 0.0

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the noise."""
        a = at(difficulty, self.amplitude_range)
        noise = _between(grid, self.downsampled_scale, lambda shape: rng.uniform(-a, a, shape))
        return np.where(grid.is_within(self.platform_width), 0.0, noise) if self.platform_width else noise


@dataclass(kw_only=True)
class PyramidSlope(SubTerrain):
    """A pyramid with a level top: every face rises towards the middle by the same angle.

    Isaac Lab's faces have this slope along the middle of each side alone and less towards the corners.

    Args:
        slope_range: angle of the easiest and of the hardest, rad.
        platform_width: edge of the top, m.
        inverted: whether it goes down towards the middle.
    """

    slope_range: NonNegativeInterval
    platform_width: NonNegative
    inverted: bool = False

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the faces and the top."""
        del rng
        slope = np.tan(at(difficulty, self.slope_range)) * (-1 if self.inverted else 1)
        return slope * np.minimum(grid.to_edge, max(0.0, min(grid.half) - self.platform_width / 2))


@dataclass(kw_only=True)
class Waves(SubTerrain):
    """``h = A / 2 (cos(k y) + sin(k x))`` from the tile's corner, with ``k = 2 pi num_waves / (edge along y)``.

    Args:
        amplitude_range: A of the easiest and of the hardest, m; heights lie within -A and A.
        num_waves: whole waves along y.
    """

    amplitude_range: NonNegativeInterval
    num_waves: Count = 1

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the waves."""
        del rng
        k = np.pi * self.num_waves / grid.half[1]
        wave = np.cos(k * (grid.y + grid.half[1])) + np.sin(k * (grid.x + grid.half[0]))
        return at(difficulty, self.amplitude_range) / 2 * wave


def _between(grid: Grid, spacing: float | None, draw: Callable[[tuple[int, int]], Array]) -> Array:
    """Return heights that are drawn on a lattice and linear between its points, first along x, then along y.

    The lattice starts at the tile's first own point inside the rim. If it started at the edge of the rim, then with a
    rim of half a cell every height would be the mean of four draws, which has half of their standard deviation.
    """
    i, u, nx = _place(grid.x.ravel(), grid.half[0], spacing)
    j, v, ny = _place(grid.y.ravel(), grid.half[1], spacing)
    drawn = draw((nx + 1, ny + 1))
    low = (1 - u)[:, None] * drawn[i][:, j] + u[:, None] * drawn[i + 1][:, j]
    high = (1 - u)[:, None] * drawn[i][:, j + 1] + u[:, None] * drawn[i + 1][:, j + 1]
    return (1 - v) * low + v * high


def _place(axis: Array, half: float, spacing: float | None) -> tuple[np.ndarray, Array, int]:
    """Return each point's lattice interval, its share of the way through that interval, and the number of intervals."""
    inside = axis[np.abs(axis) <= half + EDGE]
    own = axis[1] - axis[0] if len(axis) > 1 else 2 * half
    first, length = (inside[0], inside[-1] - inside[0]) if len(inside) else (axis[0], 0.0)
    count = max(1, int(np.ceil(length / (spacing or own) - 1e-9)))
    place = np.clip((axis - first) / (spacing or own), 0, count)
    # A point that lies on the lattice gets exactly the height drawn there, whatever rounding says.
    place = np.where(np.abs(place - np.rint(place)) < 1e-9, np.rint(place), place)
    interval = np.minimum(place.astype(int), count - 1)
    return interval, place - interval, count


_SECOND = 0.6  # of the way from platform to edge: where the second of two steps is, as in Isaac Lab


@dataclass(kw_only=True)
class Flat(SubTerrain):
    """Level ground at height 0, whatever the difficulty: one box."""

    boxes: bool = True

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return zeros."""
        del difficulty, rng
        return 0.0 * grid.to_edge


@dataclass(kw_only=True)
class PyramidStairs(SubTerrain):
    """Stairs that rise towards a level top, all around.

    Args:
        step_height_range: of the easiest and of the hardest, m.
        step_width: m.
        platform_width: greatest edge of the top, m.
        inverted: whether they go down towards the middle.
    """

    step_height_range: NonNegativeInterval
    step_width: Positive
    platform_width: NonNegative
    inverted: bool = False
    boxes: bool = True

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the stairs."""
        del rng
        count = max(0, np.ceil((2 * min(grid.half) - self.platform_width) / (2 * self.step_width) - 1e-9))
        step = at(difficulty, self.step_height_range) * (-1 if self.inverted else 1)
        return step * np.clip(np.floor(grid.to_edge / self.step_width), 0, count)


@dataclass(kw_only=True)
class RandomGrid(SubTerrain):
    """Square tiles next to each other, with heights drawn from U(-a, a).

    Args:
        grid_width: edge of a square, m.
        grid_height_range: a of the easiest and of the hardest, m.
        platform_width: edge of the level square in the middle, m.
    """

    grid_width: Positive
    grid_height_range: NonNegativeInterval
    platform_width: NonNegative

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the squares; what is left of the tile is level."""
        a = at(difficulty, self.grid_height_range)
        counts = [max(1, int(2 * half / self.grid_width + 1e-9)) for half in grid.half]
        drawn = rng.uniform(-a, a, counts)
        i, j = (
            np.floor((axis + 1e-9) / self.grid_width + count / 2).astype(int)
            for axis, count in zip((grid.x, grid.y), counts, strict=True)
        )
        inside = (i >= 0) & (i < counts[0]) & (j >= 0) & (j < counts[1]) & ~grid.is_within(self.platform_width)
        return np.where(inside, drawn[i.clip(0, counts[0] - 1), j.clip(0, counts[1] - 1)], 0.0)


@dataclass(kw_only=True)
class DiscreteObstacles(SubTerrain):
    """Level ground with blocks and pits at drawn places; a later one takes the place of an earlier one.

    Args:
        obstacle_height_mode: ``fixed`` is one height, ``choice`` one of that height, its half, and both downwards.
        obstacle_width_range: shortest and longest edge, m.
        obstacle_height_range: of the easiest and of the hardest, m.
        num_obstacles: how many.
        platform_width: edge of the level square in the middle, m.
    """

    obstacle_width_range: PositiveInterval
    obstacle_height_range: NonNegativeInterval
    num_obstacles: Count
    platform_width: NonNegative
    obstacle_height_mode: Literal["choice", "fixed"] = "choice"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the blocks."""
        height = at(difficulty, self.obstacle_height_range)
        half, (shortest, longest) = np.array(grid.half), self.obstacle_width_range
        found = 0.0 * grid.to_edge
        for _ in range(self.num_obstacles):
            share = rng.choice([-1.0, -0.5, 0.5, 1.0]) if self.obstacle_height_mode == "choice" else 1.0
            edges = np.minimum(rng.uniform(shortest, longest, 2), 2 * half)
            low = rng.uniform(-half, half - edges)
            (x0, y0), (x1, y1) = low, low + edges
            found[(grid.x >= x0) & (grid.x < x1) & (grid.y >= y0) & (grid.y < y1)] = share * height
        return np.where(grid.is_within(self.platform_width), 0.0, found)


@dataclass(kw_only=True)
class SteppingStones(SubTerrain):
    """Stones in rows along x, with holes between them; narrower and further apart with the difficulty.

    Args:
        stone_height_max: stones are drawn from U(-this, this), m.
        stone_width_range: of the hardest and of the easiest, m.
        stone_distance_range: of the easiest and of the hardest, m.
        platform_width: edge of the level square in the middle, m.
        holes_depth: height of the bottom of the holes, m.
    """

    stone_height_max: NonNegative
    stone_width_range: PositiveInterval
    stone_distance_range: NonNegativeInterval
    platform_width: NonNegative
    holes_depth: float

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the stones."""
        width = at(1 - difficulty, self.stone_width_range)
        pitch = width + at(difficulty, self.stone_distance_range)
        rows, columns = (int(np.ceil(2 * half / pitch)) + 2 for half in (grid.half[1], grid.half[0]))
        offsets = rng.uniform(0, width, rows)
        drawn = rng.uniform(-self.stone_height_max, self.stone_height_max, (rows, columns))
        y = grid.y + grid.half[1] + 1e-9
        row = (y / pitch).astype(int).clip(0, rows - 1)
        x = grid.x + grid.half[0] + pitch - offsets[row] + 1e-9
        column = (x / pitch).astype(int).clip(0, columns - 1)
        is_stone = (y - row * pitch < width) & (x - column * pitch < width)
        stones = np.where(is_stone, drawn[row, column], self.holes_depth)
        return np.where(grid.is_within(self.platform_width), 0.0, stones)


@dataclass(kw_only=True)
class Gap(SubTerrain):
    """A level square with a gap around it.

    Args:
        gap_width_range: of the easiest and of the hardest, m.
        gap_depth: m.
        platform_width: edge of the square, m.
    """

    gap_width_range: NonNegativeInterval
    gap_depth: NonNegative
    platform_width: NonNegative
    boxes: bool = True

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the gap."""
        del rng
        outer = grid.is_within(self.platform_width + 2 * at(difficulty, self.gap_width_range))
        return np.where(outer & ~grid.is_within(self.platform_width), -self.gap_depth, 0.0)


@dataclass(kw_only=True)
class Rails(SubTerrain):
    """Two square rails around the middle.

    Args:
        rail_thickness_range: of the inner and of the outer rail, m.
        rail_height_range: of the easiest and of the hardest, m.
        platform_width: edge of the square within the inner rail, m.
    """

    rail_thickness_range: PositiveInterval
    rail_height_range: NonNegativeInterval
    platform_width: NonNegative
    boxes: bool = True

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the rails."""
        del rng
        second = self.platform_width + _SECOND * (2 * min(grid.half) - self.platform_width)
        is_rail = np.zeros(grid.to_edge.shape, dtype=bool)
        for inner, thickness in zip((self.platform_width, second), self.rail_thickness_range, strict=True):
            is_rail |= grid.is_within(inner + 2 * thickness) & ~grid.is_within(inner)
        return np.where(is_rail, at(difficulty, self.rail_height_range), 0.0)


@dataclass(kw_only=True)
class Box(SubTerrain):
    """A square in the middle, raised by one step or two.

    Args:
        box_height_range: of a step, of the easiest and of the hardest, m.
        platform_width: edge of the square, m.
        double_box: whether there is a wider square around it, and so two steps.
        inverted: whether they go down, to a pit.
    """

    box_height_range: NonNegativeInterval
    platform_width: NonNegative
    double_box: bool = False
    inverted: bool = False
    boxes: bool = True

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return the box."""
        del rng
        step = at(difficulty, self.box_height_range) * (-1 if self.inverted else 1)
        second = self.platform_width + _SECOND * (2 * min(grid.half) - self.platform_width)
        wider = (1.0 if self.double_box else 0.0) * grid.is_within(second)
        return step * (grid.is_within(self.platform_width) + wider)
