"""Kinds of terrain tiles: level, rough, sloped, and stepped; and the flat places on them."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from wheelleg_exp import constraints
from wheelleg_exp.constraints import Bounds, Count, NonNegative, NonNegativeInterval, Positive, PositiveInterval
from wheelleg_exp.errors import ConfigError

Array = npt.NDArray[np.float64]
# Do not import annotations from __future__ here, because users' subclasses must inherit types, not strings.
_POINTS = 10  # As in Isaac Lab, a flat patch has similar heights at ten points on each ring around its centre.
_ROUNDS = 1000


@dataclass(kw_only=True)
class FlatPatches:
    """Flat patches of a tile: random positions are drawn until enough of them have level ground around them.

    A patch's z is the ground's height at its centre. Ranges are relative to the tile's origin and clipped to the tile.

    Args:
        num_patches: number of patches per tile, P.
        patch_radius: radius of the ring, m, or of several rings, on which the heights are compared.
        max_height_diff: largest difference of heights on a patch, m.
        x_range: m.
        y_range: m.
        z_range: lowest and highest point of a patch, m.
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
        """Return flat patches (P, 3), m, relative to the tile's origin; raise ConfigError if too few patches exist.

        ``height_at`` returns the heights (...) at points (..., 2) relative to the tile's centre. ``origin`` (3,) and
        ``size``, the edge lengths, are in m; ``key`` is the config key of the patches.
        """
        half, ranges = np.array(size) / 2, np.array([self.x_range, self.y_range])
        low = np.maximum(ranges[:, 0] + origin[:2], -half)
        high = np.maximum(np.minimum(ranges[:, 1] + origin[:2], half), low)
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
        message = f"{len(found)} of {self.num_patches} flat patches were found in {_ROUNDS * self.num_patches:,} tries"
        raise ConfigError(message, key=key, expected="a smaller patch_radius, a larger max_height_diff or wider ranges")


EDGE = 1e-9  # Because of rounding errors, a point 1e-9 m outside of a terrain tile still counts as inside.


@dataclass(frozen=True)
class Grid:
    """The grid points of a tile's heights, m, relative to the tile's centre; ``x`` (nx, 1) and ``y`` (1, ny) ascend.

    ``half`` contains half the edge lengths, m, without the tile's flat rim.
    """

    x: Array
    y: Array
    half: tuple[float, float]

    @property
    def to_edge(self) -> Array:
        """Distance of each grid point from the nearest edge of its tile, m, (nx, ny), positive inside the tile."""
        return np.minimum(self.half[0] - np.abs(self.x), self.half[1] - np.abs(self.y)) + EDGE

    def is_within(self, width: float) -> npt.NDArray[np.bool_]:
        """Return a mask (nx, ny) of the grid points inside a square of edge ``width``, m, at the tile's centre."""
        return np.maximum(np.abs(self.x), np.abs(self.y)) - EDGE <= width / 2


@dataclass(kw_only=True)
class SubTerrain:
    """A kind of tile: one YAML node under ``sub_terrains``, from this package or user-defined.

    A subclass returns heights. Boxes slow down all environments a little, a height field only robots on the field.

    Args:
        proportion: relative share of the tiles.
        border_width: width of the flat rim at height 0 inside the tile, m.
        horizontal_scale: edge of a cell, m; null means the generator's.
        flat_patches: the flat patches to find on each tile, by name.
        boxes: whether heights are those of cells, as boxes with vertical edges, or of corners, as a height field.
    """

    proportion: NonNegative
    border_width: NonNegative = 0.0
    horizontal_scale: Positive | None = None
    flat_patches: Mapping[str, FlatPatches] = field(default_factory=dict)
    boxes: bool = False
    graded: ClassVar[str] = ""  # the parameter whose range, in m or rad, the difficulty interpolates

    def label(self, difficulty: float) -> str:
        """Return what distinguishes a tile from easier ones, such as ``20mm`` or ``15°``; else the difficulty."""
        if not self.graded:
            return f"{difficulty:.3g}"
        value = at(difficulty, getattr(self, self.graded))
        is_angle = self.graded == "slope_range"
        return f"{round(math.degrees(value), 2):g}°" if is_angle else f"{round(1000 * value, 2):g}mm"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        """Return a tile's heights (nx, ny), m, at the points of ``grid``; equal arguments must give equal heights.

        ``difficulty`` is from 0 (easiest tile) to 1 (hardest tile).
        """
        raise NotImplementedError


def at(difficulty: float, interval: Sequence[float]) -> float:
    """Interpolate a terrain parameter's range ``[easiest, hardest]`` at a difficulty between 0 and 1."""
    low, high = interval
    return float(low + difficulty * (high - low))


@dataclass(kw_only=True)
class RandomUniform(SubTerrain):
    """Terrain with random heights in multiples of a step, interpolated linearly; the difficulty has no effect.

    Args:
        noise_range: lowest and highest height, m.
        noise_step: step between two heights, m.
        downsampled_scale: distance between the drawn points, m; null means the edge of a cell.
    """

    noise_range: constraints.Interval
    noise_step: Positive
    downsampled_scale: Positive | None = None

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del difficulty
        low, high = self.noise_range
        steps = int(np.floor((high - low) / self.noise_step + 1e-9))

        def draw(shape: tuple[int, int]) -> Array:
            return low + self.noise_step * rng.integers(steps + 1, size=shape).astype(float)

        return _between(grid, self.downsampled_scale, draw)


@dataclass(kw_only=True)
class UniformNoise(SubTerrain):
    """Terrain with random heights from U(-a, a), interpolated linearly; the amplitude a grows with the difficulty.

    Args:
        amplitude_range: a of the easiest and the hardest tile, m.
        downsampled_scale: distance between the drawn points, m; null means the edge of a cell.
        platform_width: edge of the level square in the centre, m.
    """

    amplitude_range: NonNegativeInterval
    downsampled_scale: Positive | None = None
    platform_width: NonNegative = 0.0
    graded: ClassVar[str] = "amplitude_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        a = at(difficulty, self.amplitude_range)
        noise = _between(grid, self.downsampled_scale, lambda shape: rng.uniform(-a, a, shape))
        return np.where(grid.is_within(self.platform_width), 0.0, noise) if self.platform_width else noise


@dataclass(kw_only=True)
class PyramidSlope(SubTerrain):
    """Terrain tile of a pyramid with a level top and four faces of equal slope.

    In Isaac Lab, the slope of a face decreases from its centre line to the corners.

    Args:
        slope_range: angle of the easiest and the hardest tile, rad.
        platform_width: edge of the top, m.
        inverted: whether the faces go down towards the centre.
    """

    slope_range: NonNegativeInterval
    platform_width: NonNegative
    inverted: bool = False
    graded: ClassVar[str] = "slope_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del rng
        slope = float(np.tan(at(difficulty, self.slope_range))) * (-1 if self.inverted else 1)
        return slope * np.minimum(grid.to_edge, max(0.0, min(grid.half) - self.platform_width / 2))


@dataclass(kw_only=True)
class Waves(SubTerrain):
    """Waves ``A / 2 (cos(k y) + sin(k x))`` with the amplitude A, and ``k = 2 pi num_waves / (tile edge along y)``.

    Args:
        amplitude_range: the amplitude A of the easiest and the hardest tile, m; the heights are between -A and A.
        num_waves: number of waves along y.
    """

    amplitude_range: NonNegativeInterval
    num_waves: Count = 1
    graded: ClassVar[str] = "amplitude_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del rng
        k = np.pi * self.num_waves / grid.half[1]
        wave = np.cos(k * (grid.y + grid.half[1])) + np.sin(k * (grid.x + grid.half[0]))
        return at(difficulty, self.amplitude_range) / 2 * wave


def _between(grid: Grid, spacing: float | None, draw: Callable[[tuple[int, int]], Array]) -> Array:
    """Draw random heights on a lattice, and interpolate the heights linearly, first along x, then along y.

    The first lattice point is a grid point, because interpolated heights vary less than drawn ones.
    """
    i, u, nx = _place(grid.x.ravel(), grid.half[0], spacing)
    j, v, ny = _place(grid.y.ravel(), grid.half[1], spacing)
    drawn = draw((nx + 1, ny + 1))
    low = (1 - u)[:, None] * drawn[i][:, j] + u[:, None] * drawn[i + 1][:, j]
    high = (1 - u)[:, None] * drawn[i][:, j + 1] + u[:, None] * drawn[i + 1][:, j + 1]
    heights: Array = (1 - v) * low + v * high
    return heights


def _place(axis: Array, half: float, spacing: float | None) -> tuple[np.ndarray, Array, int]:
    """Return the grid points' lattice intervals, their positions (0 to 1) in the intervals, and the interval count."""
    inside = axis[np.abs(axis) <= half + EDGE]
    own = axis[1] - axis[0] if len(axis) > 1 else 2 * half
    first, length = (inside[0], inside[-1] - inside[0]) if len(inside) else (axis[0], 0.0)
    count = max(1, int(np.ceil(length / (spacing or own) - 1e-9)))
    place = np.clip((axis - first) / (spacing or own), 0, count)
    # Round positions close to integers, so that a grid point at a lattice point gets exactly the random height.
    place = np.where(np.abs(place - np.rint(place)) < 1e-9, np.rint(place), place)
    interval = np.minimum(place.astype(int), count - 1)
    return interval, place - interval, count


_SECOND = 0.6  # As in Isaac Lab, the second rail or step is at 60 % of the way from a tile's platform to its edge.


@dataclass(kw_only=True)
class Flat(SubTerrain):
    """Level ground at height 0 at any difficulty: one box."""

    boxes: bool = True

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del difficulty, rng
        return 0.0 * grid.to_edge


@dataclass(kw_only=True)
class PyramidStairs(SubTerrain):
    """Terrain tile of stairs that rise from all four sides of the tile to a level top.

    The outermost ring has the height 0. In Isaac Lab, it is a step higher (``inverted``: lower), and the same settings
    give one or two more steps.

    Args:
        step_height_range: step height of the easiest and the hardest tile, m.
        step_width: m.
        platform_width: largest edge of the top, m.
        inverted: whether the stairs go down towards the centre.
    """

    step_height_range: NonNegativeInterval
    step_width: Positive
    platform_width: NonNegative
    inverted: bool = False
    boxes: bool = True
    graded: ClassVar[str] = "step_height_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del rng
        count = max(0, np.ceil((2 * min(grid.half) - self.platform_width) / (2 * self.step_width) - 1e-9))
        step = at(difficulty, self.step_height_range) * (-1 if self.inverted else 1)
        return step * np.clip(np.floor(grid.to_edge / self.step_width), 0, count)


@dataclass(kw_only=True)
class RandomGrid(SubTerrain):
    """Terrain tile of a grid of squares with random heights from U(-a, a).

    Args:
        grid_width: edge of a square, m.
        grid_height_range: a of the easiest and the hardest tile, m.
        platform_width: edge of the level square in the centre, m. Its height is 0; in Isaac Lab, it is ``a``.
    """

    grid_width: Positive
    grid_height_range: NonNegativeInterval
    platform_width: NonNegative
    graded: ClassVar[str] = "grid_height_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        a = at(difficulty, self.grid_height_range)
        counts = [max(1, int(2 * half / self.grid_width + 1e-9)) for half in grid.half]
        drawn = rng.uniform(-a, a, counts)
        axes = zip((grid.x, grid.y), counts, strict=True)
        i, j = (np.floor((axis + 1e-9) / self.grid_width + count / 2).astype(int) for axis, count in axes)
        inside = (i >= 0) & (i < counts[0]) & (j >= 0) & (j < counts[1]) & ~grid.is_within(self.platform_width)
        return np.where(inside, drawn[i.clip(0, counts[0] - 1), j.clip(0, counts[1] - 1)], 0.0)


@dataclass(kw_only=True)
class DiscreteObstacles(SubTerrain):
    """Level ground with random blocks and pits; where two overlap, the ground has the height of the one drawn later.

    Args:
        obstacle_height_mode: ``fixed`` gives all obstacles one height h; ``choice`` draws from h, h/2, -h/2, -h.
        obstacle_width_range: shortest and longest edge, m.
        obstacle_height_range: height of the easiest and the hardest tile, m.
        num_obstacles: number of obstacles.
        platform_width: edge of the level square in the centre, m.
    """

    obstacle_width_range: PositiveInterval
    obstacle_height_range: NonNegativeInterval
    num_obstacles: Count
    platform_width: NonNegative
    obstacle_height_mode: Literal["choice", "fixed"] = "choice"
    graded: ClassVar[str] = "obstacle_height_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
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
    """Terrain tile of stepping stones in rows along x; harder tiles have narrower stones and wider holes.

    Args:
        stone_height_max: largest size of a stone's height, drawn from U(-max, max), m.
        stone_width_range: width of the stones on the hardest and the easiest tile, m.
        stone_distance_range: distance between stones on the easiest and the hardest tile, m.
        platform_width: edge of the level square in the centre, m.
        holes_depth: height of the bottom of the holes, m.
    """

    stone_height_max: NonNegative
    stone_width_range: PositiveInterval
    stone_distance_range: NonNegativeInterval
    platform_width: NonNegative
    holes_depth: float

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
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
    """Terrain tile of a level square with a gap around it.

    Args:
        gap_width_range: width of the gap on the easiest and the hardest tile, m.
        gap_depth: m.
        platform_width: edge of the square, m.
    """

    gap_width_range: NonNegativeInterval
    gap_depth: NonNegative
    platform_width: NonNegative
    boxes: bool = True
    graded: ClassVar[str] = "gap_width_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del rng
        outer = grid.is_within(self.platform_width + 2 * at(difficulty, self.gap_width_range))
        return np.where(outer & ~grid.is_within(self.platform_width), -self.gap_depth, 0.0)


@dataclass(kw_only=True)
class Rails(SubTerrain):
    """Terrain tile of two square rails around the centre of the tile.

    Args:
        rail_thickness_range: thickness of the inner and the outer rail, m.
        rail_height_range: height of the rails on the easiest and the hardest tile, m.
        platform_width: edge of the square inside the inner rail, m.
    """

    rail_thickness_range: PositiveInterval
    rail_height_range: NonNegativeInterval
    platform_width: NonNegative
    boxes: bool = True
    graded: ClassVar[str] = "rail_height_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del rng
        second = self.platform_width + _SECOND * (2 * min(grid.half) - self.platform_width)
        is_rail = np.zeros(grid.to_edge.shape, dtype=bool)
        for inner, thickness in zip((self.platform_width, second), self.rail_thickness_range, strict=True):
            is_rail |= grid.is_within(inner + 2 * thickness) & ~grid.is_within(inner)
        return np.where(is_rail, at(difficulty, self.rail_height_range), 0.0)


@dataclass(kw_only=True)
class Box(SubTerrain):
    """Terrain tile with a raised square in its centre, which has one or two steps.

    Args:
        box_height_range: height of a step on the easiest and the hardest tile, m.
        platform_width: edge of the square, m.
        double_box: whether a wider square makes a second step.
        inverted: whether the steps go down into a pit.
    """

    box_height_range: NonNegativeInterval
    platform_width: NonNegative
    double_box: bool = False
    inverted: bool = False
    boxes: bool = True
    graded: ClassVar[str] = "box_height_range"

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> Array:
        del rng
        step = at(difficulty, self.box_height_range) * (-1 if self.inverted else 1)
        second = self.platform_width + _SECOND * (2 * min(grid.half) - self.platform_width)
        wider = (1.0 if self.double_box else 0.0) * grid.is_within(second)
        return step * (grid.is_within(self.platform_width) + wider)
