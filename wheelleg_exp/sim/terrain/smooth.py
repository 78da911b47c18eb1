"""Tiles without steps: rough, sloped, waved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.constraints import Count, Interval, NonNegative, NonNegativeInterval, Positive
from wheelleg_exp.sim.terrain.sub_terrain import EDGE, Array, Grid, SubTerrain, at


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
