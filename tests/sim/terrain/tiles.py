"""Grounds to vary, and a kind of tile of a user's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from wheelleg_exp.sim.terrain import Flat, Grid, SubTerrain, TerrainGenerator

CPU = torch.device("cpu")
TERRAIN = "wheelleg_exp.sim.terrain."


@dataclass(kw_only=True)
class Ramp(SubTerrain):
    """Rises along x by its difficulty."""

    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> np.ndarray:
        return difficulty * (grid.x + grid.half[0])


def generator(sub_terrains: dict[str, SubTerrain] | None = None, **changes: Any) -> TerrainGenerator:
    """Return a ground of tiles of 2 m by 1 m, not yet placed."""
    options: dict[str, Any] = {
        "size": [2.0, 1.0],
        "num_rows": 4,
        "num_cols": 3,
        "border_width": 1.0,
        "horizontal_scale": 0.1,
        "vertical_scale": 1e-4,
        "curriculum": True,
        "difficulty_range": [0.0, 1.0],
        "static_friction": 0.5,
        "dynamic_friction": 0.5,
        "restitution": 0.0,
    }
    return TerrainGenerator(**{**options, **changes}, sub_terrains=sub_terrains or {"flat": Flat(proportion=1.0)})


def placed(
    sub_terrains: dict[str, SubTerrain] | None = None, num_envs: int = 12, run_seed: int = 0, **changes: Any
) -> TerrainGenerator:
    """Return such a ground with environments on it."""
    ground, stream = generator(sub_terrains, **changes), torch.Generator().manual_seed(run_seed)
    ground.place(num_envs, 1.0, CPU, lambda: stream)
    return ground


def grid(size: tuple[float, float], cell: float, *, boxes: bool) -> Grid:
    """Return a grid over a tile without a rim: the middles of cells, or their corners."""
    counts = [round(edge / cell) for edge in size]
    x, y = (
        (np.arange(n) + 0.5) * cell - edge / 2 if boxes else np.arange(n + 1) * cell - edge / 2
        for n, edge in zip(counts, size, strict=True)
    )
    return Grid(x[:, None], y[None, :], (size[0] / 2, size[1] / 2))
