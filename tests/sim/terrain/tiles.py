from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from wheelleg_exp.sim.terrain import Flat, Grid, SubTerrain, TerrainGenerator

CPU = torch.device("cpu")
TERRAIN = "wheelleg_exp.sim.terrain."


@dataclass(kw_only=True)
class Ramp(SubTerrain):
    def heights(self, difficulty: float, grid: Grid, rng: np.random.Generator) -> np.ndarray:
        return difficulty * (grid.x + grid.half[0])


# Tiles of these options are 2 m by 1 m.
OPTIONS: dict[str, Any] = {
    **{"size": [2.0, 1.0], "num_rows": 4, "num_cols": 3, "border_width": 1.0, "horizontal_scale": 0.1},
    **{"vertical_scale": 1e-4, "curriculum": True, "difficulty_range": [0.0, 1.0]},
    **{"static_friction": 0.5, "dynamic_friction": 0.5, "restitution": 0.0},
}


def placed(
    sub_terrains: dict[str, SubTerrain] | None = None, num_envs: int = 12, run_seed: int = 0, **changes: Any
) -> TerrainGenerator:
    ground = TerrainGenerator(**{**OPTIONS, **changes}, sub_terrains=sub_terrains or {"flat": Flat(proportion=1.0)})
    stream = torch.Generator().manual_seed(run_seed)
    ground.place(num_envs, 1.0, CPU, lambda: stream)
    return ground


def grid(size: tuple[float, float], cell: float, *, boxes: bool) -> Grid:
    counts = [round(edge / cell) for edge in size]
    x, y = (
        (np.arange(n) + 0.5) * cell - edge / 2 if boxes else np.arange(n + 1) * cell - edge / 2
        for n, edge in zip(counts, size, strict=True)
    )
    return Grid(x[:, None], y[None, :], (size[0] / 2, size[1] / 2))
