"""Draws the pictures of docs/terrain.md: shaded maps of heights.

python docs/images/make_terrain_pictures.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.colors import LightSource

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.managers.manager_base import build
from wheelleg_exp.sim.terrain import (
    Box,
    DiscreteObstacles,
    Flat,
    Gap,
    PyramidSlope,
    PyramidStairs,
    Rails,
    RandomGrid,
    RandomUniform,
    SteppingStones,
    SubTerrain,
    TerrainGenerator,
    UniformNoise,
    Waves,
)

FOLDER = Path(__file__).parent
EDGE = 1.2  # m
STEPS = [0.001, 0.008]
KINDS: dict[str, SubTerrain] = {
    "Flat": Flat(proportion=1),
    "RandomUniform": RandomUniform(proportion=1, noise_range=[-0.004, 0.004], noise_step=0.001, downsampled_scale=0.02),
    "UniformNoise": UniformNoise(proportion=1, amplitude_range=[0, 0.004], downsampled_scale=0.02, platform_width=0.3),
    "PyramidSlope": PyramidSlope(proportion=1, slope_range=[0, 0.26], platform_width=0.3),
    "Waves": Waves(proportion=1, amplitude_range=[0, 0.02], num_waves=2),
    "PyramidStairs": PyramidStairs(proportion=1, step_height_range=STEPS, step_width=0.1, platform_width=0.4),
    "PyramidStairs, inverted": PyramidStairs(
        proportion=1, step_height_range=STEPS, step_width=0.1, platform_width=0.4, inverted=True
    ),
    "RandomGrid": RandomGrid(proportion=1, grid_width=0.1, grid_height_range=[0, 0.004], platform_width=0.3),
    "DiscreteObstacles": DiscreteObstacles(
        proportion=1,
        obstacle_width_range=[0.05, 0.2],
        obstacle_height_range=STEPS,
        num_obstacles=20,
        platform_width=0.3,
    ),
    "SteppingStones": SteppingStones(
        proportion=1,
        stone_height_max=0.004,
        stone_width_range=[0.1, 0.3],
        stone_distance_range=[0, 0.02],
        platform_width=0.3,
        holes_depth=-0.02,
    ),
    "Gap": Gap(proportion=1, gap_width_range=[0, 0.02], gap_depth=0.02, platform_width=0.4),
    "Rails": Rails(proportion=1, rail_thickness_range=[0.02, 0.04], rail_height_range=STEPS, platform_width=0.3),
    "Box, double": Box(proportion=1, box_height_range=STEPS, platform_width=0.3, double_box=True),
    "Pit": Box(proportion=1, box_height_range=STEPS, platform_width=0.4, inverted=True),
}


def placed(ground: TerrainGenerator) -> TerrainGenerator:
    """Return the ground, made."""
    stream = torch.Generator().manual_seed(0)
    ground.place(1, 1.0, torch.device("cpu"), lambda: stream)
    return ground


def heights(ground: TerrainGenerator, low: tuple[float, float], high: tuple[float, float], pixels: int) -> np.ndarray:
    """Return the heights of a part as a picture whose rows go along x, upwards, mm."""
    x, y = (torch.linspace(a, b, pixels, dtype=torch.float64) for a, b in zip(low, high, strict=True))
    return 1e3 * ground.height_at(torch.stack(torch.meshgrid(x, y, indexing="ij"), dim=-1)).numpy()


def shaded(axes: Any, values: np.ndarray, extent: tuple[float, float, float, float], reach: float) -> None:
    """Draw heights with light from one side, steeper than they are."""
    light, step = LightSource(azdeg=315, altdeg=45), 1e3 * (extent[1] - extent[0]) / len(values)
    colours = light.shade(
        values, plt.get_cmap("cividis"), vert_exag=6, dx=step, dy=step, vmin=-reach, vmax=reach, blend_mode="soft"
    )
    axes.imshow(colours, origin="lower", extent=extent, interpolation="bilinear")


def scene() -> None:
    """Draw all tiles of scene=rough."""
    node = compose(["scene=rough", "env.scene.terrain.border_width=0.3"]).config["env"]["scene"]["terrain"]
    ground = placed(build(node, "env.scene.terrain"))
    x, y = (edge * count / 2 + 0.3 for edge, count in zip(ground.size, (10, 10), strict=True))
    figure, axes = plt.subplots(figsize=(7.5, 7.2), dpi=110, layout="constrained")
    shaded(axes, heights(ground, (-x, -y), (x, y), 1400), (-y, y, -x, x), 40)
    names, columns = list(ground.sub_terrains), ground.terrain_origins
    for column in range(10):
        name = names[ground.kinds[0, column]]
        axes.text(float(columns[0, column, 1]), x + 0.05, name, rotation=45, fontsize=8)
    axes.set(xlabel="y (m): kinds", ylabel="x (m): levels, 0 to 9")
    figure.colorbar(plt.cm.ScalarMappable(plt.Normalize(-40, 40), "cividis"), ax=axes, label="height (mm)", shrink=0.7)
    figure.savefig(FOLDER / "terrain.png")


def kinds() -> None:
    """Draw the hardest tile of each kind."""
    figure, all_axes = plt.subplots(3, 5, figsize=(11, 7), dpi=100, layout="constrained")
    for axes in all_axes.flat:
        axes.set_axis_off()
    for axes, (name, kind) in zip(all_axes.flat, KINDS.items(), strict=False):
        ground = placed(
            TerrainGenerator(
                size=[EDGE, EDGE],
                num_rows=1,
                num_cols=1,
                border_width=0.0,
                horizontal_scale=0.01,
                vertical_scale=1e-4,
                curriculum=True,
                difficulty_range=[1.0, 1.0],
                sub_terrains={"kind": kind},  # type: ignore[dict-item]
                static_friction=0.5,
                dynamic_friction=0.5,
                restitution=0.0,
            )
        )
        values = heights(ground, (-EDGE / 2, -EDGE / 2), (EDGE / 2, EDGE / 2), 400)
        shaded(axes, values, (-EDGE / 2, EDGE / 2, -EDGE / 2, EDGE / 2), max(1.0, float(np.abs(values).max())))
        axes.set_title(f"{name}\n{values.min():.0f} to {values.max():.0f} mm", fontsize=9)
    figure.savefig(FOLDER / "terrain_kinds.png")


if __name__ == "__main__":
    scene()
    kinds()
