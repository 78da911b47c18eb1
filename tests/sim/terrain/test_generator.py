import hashlib
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import torch

from sim.terrain.tiles import OPTIONS, TERRAIN, Ramp, placed
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.progress import progress_to
from wheelleg_exp.sim.terrain import (
    DiscreteObstacles,
    Flat,
    FlatPatches,
    Gap,
    PyramidSlope,
    PyramidStairs,
    RandomGrid,
    TerrainGenerator,
    UniformNoise,
    Waves,
)

BLOCKS = {"proportion": 1, "obstacle_width_range": [0.1, 0.5], "obstacle_height_range": [0, 0.1]}
BLOCKS |= {"num_obstacles": 9, "platform_width": 0.2, "boxes": True}


def stairs(proportion=1, **options):
    steps = {"step_height_range": [0.0, 0.1], "step_width": 0.1, "platform_width": 0.4}
    return PyramidStairs(proportion=proportion, **steps, **options)


def noise(proportion=1, **options):
    return UniformNoise(proportion=proportion, amplitude_range=[0.0, 0.1], **options)


def everything():
    return {
        "noise": noise(),
        "slope": PyramidSlope(proportion=1, slope_range=[0.1, 0.5], platform_width=0.2, border_width=0.15),
        "stairs": stairs(),
        "waves": Waves(proportion=1, amplitude_range=[0.0, 0.1], horizontal_scale=0.07),
        "grid": RandomGrid(proportion=1, grid_width=0.2, grid_height_range=[0.0, 0.1], platform_width=0.3),
        "gap": Gap(proportion=1, gap_width_range=[0.1, 0.2], gap_depth=0.2, platform_width=0.4),
        "blocks": DiscreteObstacles(**BLOCKS),
    }


def test_columns_are_shared_out_by_proportion_and_rows_grow_harder():
    kinds = {"a": Flat(proportion=0.4), "b": noise(proportion=0.6), "c": stairs(proportion=1.0)}
    ground = placed(kinds, num_cols=10, num_rows=5, difficulty_range=[0.2, 0.7])
    assert ground.kinds.tolist() == [[0, 0, 1, 1, 1, 2, 2, 2, 2, 2]] * 5
    low = 0.2 + 0.1 * np.arange(5)[:, None]
    assert ((ground.difficulties >= low) & (ground.difficulties < low + 0.1)).all()
    assert np.ptp(ground.difficulties, axis=1).min() > 0


def test_without_a_curriculum_kind_and_difficulty_are_drawn():
    kinds = {"a": Flat(proportion=1), "b": noise(proportion=3)}
    ground = placed(kinds, num_cols=30, num_rows=30, curriculum=False, difficulty_range=[0.5, 1.0])
    assert ground.kinds.mean() == pytest.approx(0.75, abs=0.05)
    assert 0.5 <= ground.difficulties.min() < 0.51 < 0.74 < ground.difficulties.mean() < 0.76
    assert abs(np.corrcoef(ground.difficulties.ravel(), np.repeat(range(30), 30))[0, 1]) < 0.1


def test_rows_go_along_x_and_columns_along_y_around_the_origin():
    ground = placed()
    x, y = torch.tensor([-3.0, -1.0, 1.0, 3.0]), torch.tensor([-1.0, 0.0, 1.0])
    assert torch.equal(ground.terrain_origins[..., :2], torch.stack(torch.meshgrid(x, y, indexing="ij"), dim=-1))
    assert (ground.size, ground.max_terrain_level) == ((2.0, 1.0), 4)


def test_an_origin_is_as_high_as_the_highest_point_of_the_window():
    ramp = {"ramp": Ramp(proportion=1)}
    for window, reach in [(0.0, 0.0), (0.25, 0.25), (1.0, 1.0)]:
        ground = placed(ramp, difficulty_range=[1.0, 1.0], origin_window=window)
        assert ground.terrain_origins[0, 0, 2] == pytest.approx(1.0 + reach, abs=0.1001)
        assert ground.terrain_origins[0, 0, 2] >= 1.0 + reach - 1e-6


def test_the_ground_has_height_0_at_nan_and_inf():
    ground = placed({"stairs": stairs()}, border_width=1.0)
    points = torch.tensor([[torch.nan, 0.0], [0.0, torch.inf], [-torch.inf, torch.nan]])
    assert ground.height_at(points).tolist() == [0.0, 0.0, 0.0]


def test_steps_and_roughness_of_each_row_are_those_of_its_difficulty():
    ground = placed({"stairs": stairs(), "noise": noise()}, num_rows=10, num_cols=2, horizontal_scale=0.02)
    hard = ground.difficulties
    x, y = torch.meshgrid(torch.linspace(-0.99, 0.99, 200), torch.linspace(-0.49, 0.49, 100), indexing="ij")
    heights = ground.height_at(torch.stack((x, y), dim=-1) + ground.terrain_origins[:, :, None, None, :2]).numpy()
    top = heights[:, 0].max(axis=(1, 2))
    assert top == pytest.approx(3 * 0.1 * hard[:, 0], abs=3e-4)  # The stairs have (1 - 0.4) / 0.2 = 3 steps.
    # The mean square of interpolated heights is half of the mean square of the corners' heights.
    assert heights[:, 1].std(axis=(1, 2)) == pytest.approx(0.1 * hard[:, 1] / np.sqrt(6), rel=0.08)


def test_the_height_at_a_point_is_where_a_ray_meets_mujocos_ground():
    ground = placed(everything(), num_rows=3, num_cols=7)
    points = torch.rand(4000, 2, dtype=torch.float64) * torch.tensor([8.0, 9.0]) - torch.tensor([4.0, 4.5])
    found, expected = ground.height_at(points), ground.probe.height_at(points)
    torch.testing.assert_close(found, expected, atol=2e-6, rtol=0)
    assert found.std() > 0.02
    assert not ground.height_at(torch.tensor([[3.5, 0.0], [0.0, -4.4], [99.0, 99.0]])).any()


def test_stairs_consist_of_the_fewest_possible_boxes():
    spec = mujoco.MjSpec()
    placed({"stairs": stairs()}, num_rows=1, num_cols=1, difficulty_range=[1, 1], border_width=0.0).add_to(spec)
    # The stairs are one box for the ground and three for the steps.
    assert [geom.type for geom in spec.geoms] == [mujoco.mjtGeom.mjGEOM_BOX] * 4


def test_the_border_surrounds_the_tiles_at_height_zero():
    points = torch.tensor([[4.9, 2.4], [-4.9, 0.0], [0.0, -2.4], [4.5, 0.3], [5.1, 0.0], [0.0, 2.6]])
    assert placed().probe.height_at(points, outside=-1.0).tolist() == pytest.approx([0.0] * 4 + [-1.0] * 2, abs=1e-6)


def digest() -> str:
    return hashlib.sha256(b"".join(tile.heights.tobytes() for tile in placed(everything()).tiles)).hexdigest()


def test_one_seed_gives_one_ground_in_any_process():
    code = "from sim.terrain.test_generator import digest; print(digest())"
    env = {**os.environ, "PYTHONPATH": ":".join(sys.path), "OMP_NUM_THREADS": "4"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env)
    assert done.stdout.strip() == digest()


def test_the_runs_seed_makes_the_ground_unless_it_has_its_own():
    first, second, third = (placed({"n": noise()}, run_seed=s).tiles[5].heights for s in (1, 2, 1))
    assert np.array_equal(first, third)
    assert not np.array_equal(first, second)
    fixed = [placed({"n": noise()}, run_seed=s, seed=7) for s in (1, 2)]
    assert np.array_equal(fixed[0].tiles[5].heights, fixed[1].tiles[5].heights)
    assert np.array_equal(fixed[0].difficulties, fixed[1].difficulties)


def test_flat_patches_are_flat_and_in_their_ranges():
    wanted = FlatPatches(num_patches=20, patch_radius=[0.05, 0.1], max_height_diff=0.0, x_range=[-0.3, 0.9])
    kinds = {"stairs": stairs(flat_patches={"goal": wanted}), "flat": Flat(proportion=1)}
    ground = placed(kinds, num_cols=2, difficulty_range=[1.0, 1.0])
    places = ground.flat_patches["goal"]
    assert places.shape == (4, 2, 20, 3)
    torch.testing.assert_close(places[..., 2], ground.height_at(places[..., :2]), atol=1e-5, rtol=0)
    seen = places[:, 0] - ground.terrain_origins[:, 0, None]
    assert ((seen[..., 0] >= -0.3) & (seen[..., 0] <= 0.9) & (seen[..., 1].abs() <= 0.5)).all()
    for angle in torch.arange(10) * 2 * torch.pi / 10:
        rim = places[:, 0, :, :2] + 0.1 * torch.stack((angle.cos(), angle.sin()))
        torch.testing.assert_close(ground.height_at(rim), places[:, 0, :, 2], atol=1e-5, rtol=0)
    assert torch.equal(places[:, 1], ground.terrain_origins[:, 1, None].expand(4, 20, 3))


def test_a_tile_that_is_nowhere_flat_is_rejected():
    rough = noise(flat_patches={"goal": FlatPatches(num_patches=1, patch_radius=0.2, max_height_diff=0.001)})
    message = r"sub_terrains\.n\.flat_patches\.goal: 0 of 1 flat patches .*smaller patch_radius"
    with pytest.raises(ConfigError, match=message):
        placed({"n": rough}, difficulty_range=[1, 1])


STAIRS = {"_target_": TERRAIN + "PyramidStairs", "proportion": 1.0, "step_height_range": [0.0, 0.1]}
STAIRS |= {"step_width": 0.2, "platform_width": 1.0}
NODE = {**OPTIONS, "_target_": TERRAIN + "TerrainGenerator", "size": [2.0, 2.0], "num_rows": 3, "num_cols": 2}
NODE |= {"vertical_scale": 0.001, "difficulty_range": [1.0, 1.0], "sub_terrains": {"stairs": STAIRS, "gone": None}}
NOISE = {"_target_": TERRAIN + "UniformNoise", "proportion": 1.0, "amplitude_range": [0.0, 0.01]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": [1.0]}, r"size.*2 finite numbers"),
        ({"num_rows": 0}, r"num_rows.*at least 1"),
        ({"difficulty_range": [0.0, 2.0]}, r"difficulty_range.*at most 1"),
        ({"sub_terrains": {"n": {**NOISE, "proportion": 0.0}}}, r"sub_terrains.*no sub-terrain has a proportion"),
        ({"sub_terrains": {"n": {**NOISE, "amplitud": 1}}}, r"sub_terrains\.n\.amplitud"),
        ({"sub_terrains": {"n": {**NOISE, "border_width": 1.0}}}, r"n\.border_width.*less than half a tile's edge, 1"),
        ({"sub_terrains": {"n": {**NOISE, "border_width": -1.0}}}, r"n\.border_width.*at least 0"),
        ({"horizontal_scale": 1e-7}, r"horizontal_scale.*cells of the ground"),
    ],
)
def test_wrong_settings_name_their_key(make_env, change, message):
    with pytest.raises(ConfigError, match=message):
        make_env("block", scene={"terrain": {**NODE, **change}})


@pytest.mark.usefixtures("allow_test_terms")
def test_a_user_defined_sub_terrain_is_used(make_env):
    ramp = {"_target_": "sim.terrain.tiles.Ramp", "proportion": 1.0}
    ground = make_env("block", scene={"terrain": {**NODE, "sub_terrains": {"ramp": ramp}}}).scene.terrain
    assert isinstance(ground, TerrainGenerator)
    assert ground.height_at(torch.tensor([0.5, 1.0])) == pytest.approx(1.5)


def test_long_builds_report_their_progress():
    heard = []
    with progress_to(lambda *progress: heard.append(progress)):
        placed(num_rows=2, num_cols=3).add_to(mujoco.MjSpec())
    assert heard == [(what, done, 6) for what in ("making tiles", "laying tiles") for done in range(1, 7)]
