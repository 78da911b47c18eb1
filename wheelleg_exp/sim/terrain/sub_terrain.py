"""What one tile of a generated ground is like: heights over a grid, by difficulty."""

# The annotations here are values and no text, because dataclasses in other modules inherit the fields.

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from wheelleg_exp.constraints import NonNegative, Positive
from wheelleg_exp.sim.terrain.flat_patches import FlatPatches
from wheelleg_exp.state import Kept

Array = npt.NDArray[np.float64]
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
