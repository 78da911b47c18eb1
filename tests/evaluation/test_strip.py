"""Test the strip terrain (its geometry, the measured phases, the success of crossings), and the size of tiles."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from sim.terrain.tiles import placed

from evaluation.conftest import balancer, protocol
from evaluation.synthetic import DT, fall, still, times
from wheelleg_exp.evaluation import disturbance_tests, evaluate
from wheelleg_exp.evaluation.disturbance_tests import tiles
from wheelleg_exp.evaluation.protocol_options import Strip, Terrain
from wheelleg_exp.evaluation.scenarios import on_terrain
from wheelleg_exp.evaluation.trajectories import Trajectories
from wheelleg_exp.managers.manager_base import build
from wheelleg_exp.sim.terrain import PyramidSlope, TerrainGenerator, UniformNoise

ALONE = "protocol.terrain=null"
FRICTION = {"static_friction": 0.5, "dynamic_friction": 0.5, "restitution": 0.0}


def options(**changes: Any) -> Strip:
    node = protocol("terrain", ALONE)["strip"]
    return Strip(**{**node, "horizon_s": 9.0, "before": 0.9, "length": 0.6, **changes})


def made_ground(asked: Strip) -> TerrainGenerator:
    node = disturbance_tests.strip_ground(asked, FRICTION, seed=3)
    kinds = {
        name: UniformNoise(**{key: value for key, value in kind.items() if key != "_target_"})
        for name, kind in node.pop("sub_terrains").items()
    }
    ground = TerrainGenerator(**{key: value for key, value in node.items() if key != "_target_"}, sub_terrains=kinds)
    ground.place(2, 1.0, torch.device("cpu"), lambda: torch.Generator().manual_seed(0))
    return ground


def test_strips_have_the_configured_place_and_roughness():
    asked = options(amplitudes=[0.002, 0.004])
    ground, cell = made_ground(asked), torch.tensor([0, 1])
    rollout = SimpleNamespace(
        env=SimpleNamespace(scene=SimpleNamespace(terrain=ground), device=torch.device("cpu")),
        scenarios=SimpleNamespace(cell_of=lambda: cell),
    )
    disturbance_tests.place_before_strip(rollout, asked)
    x = torch.linspace(-0.5, 3.2, 3701)
    for amplitude, origin in zip(asked.amplitudes, ground.env_origins, strict=True):
        assert origin[2] == 0.0
        lines = [ground.height_at(origin[:2] + torch.stack((x, torch.full_like(x, y)), dim=1)) for y in (-0.4, 0, 0.4)]
        heights = torch.stack(lines).abs()
        inside = (x > 0.9) & (x < 1.5)
        assert heights.max() <= amplitude + asked.vertical_scale / 2
        assert heights[:, inside].max() > 0.8 * amplitude
        flat = heights[:, inside].square().mean().sqrt()  # Linear interpolation gives less than a / sqrt(3).
        assert 0.6 * amplitude / math.sqrt(3) < flat < amplitude / math.sqrt(3)
        assert heights[:, (x < 0.88 - 1e-3) | (x > 1.52 + 1e-3)].max() == 0.0
    node = disturbance_tests.strip_ground(asked, FRICTION, seed=3)
    assert node["border_width"] >= asked.lin_vel_x * asked.horizon_s - asked.before - asked.length


def drive(seconds: float = 9.0, n: int = 1, speed: float = 0.3) -> Trajectories:
    """Return episodes of robots that drive at the commanded speed from the start."""
    made = still(seconds, n)
    made.pos[..., 0] = (speed * times(made)).unsqueeze(1)
    made.vel[..., 0] = speed
    made.command[..., 0] = 0.3
    return made


def test_what_is_measured_where():
    made, asked = drive(), options(quiet_s=1.0)  # The robots reach the strip at 3 s and leave it at 5 s.
    time = times(made)
    wave = math.sqrt(2.0) * torch.sin(2 * math.pi * 4 * time)  # The RMS is 1, and each phase has whole periods.
    parts = torch.where(time < 3.0, 0.01, torch.where(time <= 5.0, 0.2, 0.03))
    wave *= torch.where(time < 2.0, 0.5, parts)  # The motion at the start does not count.
    made.pitch[:, 0] = -0.1 + wave  # The robot leans.
    made.vel[:, 0, 0] += parts
    found = disturbance_tests.crossing(made, asked, settle_s=1.0)
    for name, size in (("before", 0.01), ("on", 0.2), ("behind", 0.03)):
        assert float(found[f"swing_rad_{name}"]) == pytest.approx(size, rel=0.05), name
        assert float(found[f"error_vx_{name}"]) == pytest.approx(size, rel=0.05), name
    assert (float(found["distance_ratio"]), float(found["success"])) == (pytest.approx(1.0, abs=0.01), 1.0)
    assert float(found["recovered"]) == 0.0  # The RMS stays three times as large as before the strip.
    assert math.isnan(float(found["recovery_s"]))


@pytest.mark.parametrize(("swings_s", "recovered"), [(0.8, 1.0), (2.4, 1.0), (2.7, 0.0)])
def test_recovery_is_when_it_is_as_quiet_as_before(swings_s, recovered):
    made, asked = drive(), options(within_s=2.5)
    time = times(made)
    lean = 0.05  # A constant lean is not a swing.
    made.pitch[:, 0] = lean + torch.where((time > 3.0) & (time < 5.0 + swings_s), 0.1, 0.0)
    found = disturbance_tests.crossing(made, asked, settle_s=1.0)
    assert float(found["recovery_s"]) == pytest.approx(swings_s, abs=3 * DT)
    assert float(found["recovered"]) == recovered


def test_who_falls_stops_or_comes_late_has_not_recovered():
    made, asked = drive(n=4), options()
    fall(made, 0, 4.0)  # The robot falls on the strip.
    made.pos[:, 1, 0] = made.pos[:, 1, 0].clamp(max=0.5)  # The robot never reaches the strip.
    made.pos[:, 2, 0] *= 0.25 / 0.3  # The robot leaves the strip at 6 s, early enough.
    made.pos[:, 3, 0] *= 0.2 / 0.3  # The robot leaves the strip at 7.5 s, too late.
    found = disturbance_tests.crossing(made, asked, settle_s=1.0)
    assert found["recovered"].tolist() == found["success"].tolist() == [0.0, 0.0, 1.0, 0.0]
    assert found["distance_ratio"].tolist() == pytest.approx([4 / 9, 0.5 / 2.7, 0.25 / 0.3, 0.2 / 0.3], abs=0.01)
    assert math.isnan(float(found["error_vx_on"][1]))
    assert math.isnan(float(found["error_vx_behind"][0]))


SMALL = (ALONE, "protocol.strip.episodes=2")


def test_the_reference_comes_over_and_swings_most_on_the_strip(task):
    found = evaluate(*task, balancer(1.0), protocol("terrain", *SMALL, "protocol.strip.amplitudes=[0.00003,0.002]"))
    assert (found.value("strip/survival"), found.value("strip/success")) == (1.0, 1.0)
    assert found.value("strip/recovered/0.03mm") == 1.0
    on, before = (found.value(f"strip/swing_{where}/2mm") for where in ("on", "before"))
    assert on > 2 * before
    assert on > 5 * found.value("strip/swing_on/0.03mm")
    assert found.value("strip/distance_ratio/2mm") == pytest.approx(1.0, abs=0.1)


def test_robots_begin_on_the_floor_of_a_pit_however_wide_the_tile():
    made = tiles(Terrain(**protocol("terrain")["terrain"]), seed=3)
    pit = {key: value for key, value in made["sub_terrains"]["slope_inverted"].items() if key != "_target_"}
    names = ("horizontal_scale", "vertical_scale", "origin_window", "size", "difficulty_range")
    settings = {key: made[key] for key in names}
    ground = placed({"pit": PyramidSlope(**pit)}, num_rows=2, num_cols=1, curriculum=True, seed=3, **settings)
    floors = [float(tile.heights.min()) for tile in ground.tiles]
    assert min(floors) < -0.2  # deep pits
    assert ground.terrain_origins[:, 0, 2].tolist() == pytest.approx(floors, abs=2e-3)


def _measured(kind: str, heights: np.ndarray, cell: float) -> float:
    """Return the height of a tile's steps or the amplitude of its ground, mm, or the angle of its slopes, degrees."""
    if kind.startswith("slope"):
        return math.degrees(math.atan(float(np.abs(np.diff(heights, axis=0)).max()) / cell))
    if kind.startswith(("step", "stairs")):
        steps = np.diff(np.unique(heights))
        assert np.ptp(steps) < 2e-4  # Heights are multiples of 0.1 mm.
        return 1000.0 * float(np.ptp(heights)) / len(steps)
    return 1000.0 * float(np.abs(heights).max())


@pytest.mark.parametrize("name", ["terrain", "steps"])
def test_evaluated_tiles_are_as_high_as_their_labels_say(name):
    asked = Terrain(**protocol(name)["terrain"])
    ground = build(tiles(asked, seed=2026), "env.scene.terrain")
    ground.place(4, 1.0, torch.device("cpu"), lambda: torch.Generator().manual_seed(0))
    labels = [label.split("/") for label in on_terrain(asked).names]
    assert len(labels) == len(ground.tiles)
    for number, (kind, label) in enumerate(labels):
        tile = ground.tiles[number % asked.levels * ground.num_cols + number // asked.levels]
        found = _measured(kind, tile.heights, asked.size[0] / (len(tile.heights) - 1))
        # Random heights almost reach their amplitude.
        share = 0.05 if kind in ("rough", "grid", "waves") else 0.0
        assert found == pytest.approx(float(label.rstrip("m°")), abs=0.1, rel=share)
    assert {label for kind, label in labels if kind == "step_up"} <= {f"{mm}mm" for mm in (5, 10, 15, 20, 25, 30)}
