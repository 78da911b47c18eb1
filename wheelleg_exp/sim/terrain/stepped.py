"""Tiles with steps: level, stairs, boxes, obstacles, stones, gaps, rails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from wheelleg_exp.constraints import Count, NonNegative, NonNegativeInterval, Positive, PositiveInterval
from wheelleg_exp.sim.terrain.sub_terrain import Array, Grid, SubTerrain, at

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
