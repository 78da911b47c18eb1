"""Tiles without steps: rough, sloped, waved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.constraints import Count, Interval, NonNegative, NonNegativeInterval, Positive
from wheelleg_exp.sim.terrain.sub_terrain import Array, Grid, SubTerrain, at


@dataclass(kw_only=True)
class RandomUniform(SubTerrain):
    """Heights drawn from equal steps within a range, straight between the points; difficulty changes nothing.

    Args:
        noise_range: lowest and highest, m.
        noise_step: between two heights, m.
        downsampled_scale: between the drawn points, m; null is the edge of a cell.
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
    """Heights drawn from U(-a, a), straight between the points; the amplitude a grows with the difficulty.

    Args:
        amplitude_range: a of the easiest and of the hardest, m.
        downsampled_scale: between the drawn points, m; null is the edge of a cell.
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
    """Return heights that are drawn at points and straight between them, first along x, then along y."""
    own = (grid.x[1, 0] - grid.x[0, 0], grid.y[0, 1] - grid.y[0, 0])
    counts = [max(1, round(2 * half / (spacing or step))) for half, step in zip(grid.half, own, strict=True)]
    drawn = draw((counts[0] + 1, counts[1] + 1))
    (i, u), (j, v) = (
        _place(axis.ravel(), half, count) for axis, half, count in zip((grid.x, grid.y), grid.half, counts, strict=True)
    )
    low = (1 - u)[:, None] * drawn[i][:, j] + u[:, None] * drawn[i + 1][:, j]
    high = (1 - u)[:, None] * drawn[i][:, j + 1] + u[:, None] * drawn[i + 1][:, j + 1]
    return (1 - v) * low + v * high


def _place(axis: Array, half: float, count: int) -> tuple[np.ndarray, Array]:
    """Return between which drawn points a coordinate lies, and how far it is from the first to the second."""
    at_ = np.clip((axis + half) / (2 * half) * count, 0, count)
    first = np.minimum(at_.astype(int), count - 1)
    return first, at_ - first
