import numpy as np
import pytest
import torch

from sim.terrain.tiles import CPU
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.managers.manager_base import build
from wheelleg_exp.sim.terrain import TerrainGenerator


def made(scene: str) -> TerrainGenerator:
    node = compose([f"scene={scene}"]).config["env"]["scene"]["terrain"]
    ground, stream = build(node, "env.scene.terrain"), torch.Generator().manual_seed(0)
    ground.place(4, 1.0, CPU, lambda: stream)
    return ground


def tiles(ground: TerrainGenerator, pixels: int = 241) -> np.ndarray:
    line = torch.linspace(-0.599, 0.599, pixels, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(line, line, indexing="ij"), dim=-1)
    return ground.height_at(points + ground.terrain_origins[:, :, None, None, :2]).numpy()


def test_the_hardest_row_of_rough_ground_is_what_a_wheel_can_just_roll_over():
    ground = made("rough")
    heights, names = tiles(ground), list(ground.sub_terrains)
    columns = {name: np.flatnonzero(ground.kinds[0] == k) for k, name in enumerate(names)}
    assert {name: len(found) for name, found in columns.items()} == {
        "rough": 3,
        **dict.fromkeys(("slope", "slope_inverted", "stairs", "stairs_inverted", "grid", "waves", "obstacles"), 1),
    }
    first, last = heights[0].std(axis=(1, 2)), heights[9].std(axis=(1, 2))
    assert (last > 3 * first).all()
    assert (first < 0.008).all()
    for name, highest in {"rough": 0.004, "grid": 0.004, "waves": 0.01, "obstacles": 0.008}.items():
        found = np.abs(heights[9][columns[name]]).max()
        assert 0.7 * highest < found <= highest + 1e-6
    rise = np.abs(np.diff(heights[9, columns["slope"][0]], axis=0)).max() / (1.198 / 240)
    assert np.arctan(rise) == pytest.approx(0.26 * ground.difficulties[9, columns["slope"][0]], abs=3e-3)


def test_stairs_have_four_steps_of_the_rows_difficulty():
    ground = made("stairs")
    heights, hard = tiles(ground), ground.difficulties
    step = 0.001 + 0.007 * hard
    assert heights[:, 0].max(axis=(1, 2)) == pytest.approx(4 * step[:, 0], abs=3e-4)
    assert heights[:, 1].min(axis=(1, 2)) == pytest.approx(-4 * step[:, 1], abs=3e-4)
    top = 4 * step[ground.terrain_levels, ground.terrain_types]
    assert ground.env_origins[:, 2].abs() == pytest.approx(top, abs=3e-4)
