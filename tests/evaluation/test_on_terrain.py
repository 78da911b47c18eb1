"""Test that the terrain protocol has the same kinds of tiles as training, in a larger size."""

import pytest
from sim.terrain.tiles import placed

from evaluation.conftest import protocol
from wheelleg_exp.evaluation.protocol_options import Terrain
from wheelleg_exp.evaluation.terrain_tests import tiles
from wheelleg_exp.sim.terrain import PyramidSlope


def test_robots_begin_on_the_floor_of_a_pit_however_wide_the_tile():
    made = tiles(Terrain(**protocol("terrain")["terrain"]), seed=3)
    pit = {key: value for key, value in made["sub_terrains"]["slope_inverted"].items() if key != "_target_"}
    names = ("horizontal_scale", "vertical_scale", "origin_window", "size", "difficulty_range")
    settings = {key: made[key] for key in names}
    ground = placed({"pit": PyramidSlope(**pit)}, num_rows=2, num_cols=1, curriculum=True, seed=3, **settings)
    floors = [float(tile.heights.min()) for tile in ground.tiles]
    assert min(floors) < -0.2  # deep pits
    assert ground.terrain_origins[:, 0, 2].tolist() == pytest.approx(floors, abs=2e-3)


def test_steps_are_three_halves_of_a_wheels_radius_high_at_most():
    made = tiles(Terrain(**protocol("steps")["terrain"]), seed=3)
    heights = {
        name: node.get("step_height_range") or node.get("box_height_range")
        for name, node in made["sub_terrains"].items()
    }
    assert heights == {name: [0.005, 0.03] for name in ("stairs", "stairs_inverted", "step", "step_inverted")}
    assert made["size"] == [4.0, 4.0]
