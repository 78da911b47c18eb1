import math

import pytest
import torch

from sim.sensors.grounds import STEP
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.terrain import Plane

pytestmark = pytest.mark.usefixtures("allow_test_terms")
PREFIX = "wheelleg_exp.sim.sensors."
GRID = {"_target_": PREFIX + "GridPattern", "resolution": 0.5, "size": [1.0, 0.5]}
ONE = {**GRID, "size": [0.0, 0.0]}
STILL = torch.zeros(4, 1)
ALL = torch.arange(4)


@pytest.fixture
def make(start_env):
    def build(ground=None, seed=0, **settings):
        node = {"_target_": PREFIX + "RayCaster", "body_name": "block", "pattern": GRID, **settings}
        scene = {"sensors": {"scan": node}} | ({} if ground is None else {"terrain": ground})
        return start_env("block", seed=seed, scene=scene)

    return build


def place(env, pos, yaw=0.0, pitch=0.0, ids=ALL):
    quat = rotation.quat_from_euler_xyz(*(torch.full((len(ids),), angle) for angle in (0.0, pitch, yaw)))
    env.scene.robot.write_root_pose_to_sim(torch.cat((torch.tensor(pos).expand(len(ids), 3), quat), dim=1), ids)
    env.scene.refresh()
    return env.scene["scan"].data


def points(*rows):
    return torch.tensor(rows).expand(4, len(rows), 3)


def test_on_a_plane_the_scan_turns_with_the_yaw_alone(make):
    env = make(ray_alignment="yaw", offset={"pos": [0.0, 0.0, 20.0]})
    data = place(env, [1.0, 2.0, 0.7], yaw=math.pi / 2, pitch=0.4)
    turned = [[1.0 - y, 2.0 + x, 0.0] for y in (-0.25, 0.25) for x in (-0.5, 0.0, 0.5)]
    torch.testing.assert_close(data.ray_hits_w, points(*turned), atol=1e-5, rtol=0)
    torch.testing.assert_close(data.pos_w, torch.tensor([1.0, 2.0, 0.7]).expand(4, 3))
    torch.testing.assert_close(data.quat_w, env.scene.robot.data.root_quat_w)


QUARTER = [math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 0.0]
FIXED = [[1.0 + x, 2.0 + y, 0.0] for y in (-0.25, 0.25) for x in (-0.5, 0.0, 0.5)]
ON_STEP = [[3.75 + x, y, 0.0] for y in (0.65, 1.15) for x in (-0.5, 0.0, 0.5)]
FAR, LEVEL = [[6.0, 0.0, 0.2]], [[0.5 * math.cos(0.3) - 0.7 * math.tan(0.3), 0.0, 0.0]]
ON_STEP[2][2] = 0.25  # Only this ray hits the step.


@pytest.mark.parametrize(
    ("ground", "settings", "place_at", "hits"),
    [
        (None, {"ray_alignment": "world"}, {"pos": [1.0, 2.0, 0.7], "yaw": 1.0, "pitch": 0.4}, FIXED),
        (None, {"pattern": ONE}, {"pos": [0.0, 0.0, 0.7], "pitch": 0.3}, [[-0.7 * math.tan(0.3), 0.0, 0.0]]),
        # An offset turns the directions and moves the starts. The hit is on the far side of the box.
        (STEP, {"pattern": ONE, "offset": {"pos": [0.0, 0.0, -0.1], "rot": QUARTER}}, {"pos": [8.0, 0.0, 0.3]}, FAR),
        (STEP, {"ray_alignment": "yaw"}, {"pos": [3.75, 0.9, 0.6]}, ON_STEP),
        # A drift of the rays is level however the body is tilted.
        (
            None,
            {"pattern": ONE, "ray_cast_drift_range": {"x": [0.5, 0.5]}},
            {"pos": [0.0, 0, 0.7], "pitch": 0.3},
            LEVEL,
        ),
    ],
    ids=["world alignment", "base alignment", "offset", "step", "drift"],
)
def test_rays_hit_the_ground_at_the_geometric_distance(make, ground, settings, place_at, hits):
    found = place(make(ground, **settings), **place_at).ray_hits_w
    torch.testing.assert_close(found, points(*hits), atol=1e-5, rtol=0)


def test_the_height_of_a_plane_is_bitwise_that_of_cast_rays(make, monkeypatch):
    env, hits = make(ray_alignment="yaw", offset={"pos": [0.1, 0.2, 1.3]}), []
    for has_formula in (True, False):
        monkeypatch.setattr(Plane, "has_formula", has_formula)
        hits.append(place(env, [13.37, -4.2, 0.731], yaw=0.6, pitch=0.4).ray_hits_w.clone())
        assert place(env, [0.0, 0.0, -9.0]).ray_hits_w.isinf().all()  # A ray from below misses a plane.
    assert torch.equal(*hits)


def test_a_ray_that_meets_nothing_or_is_too_short_is_a_miss(make):
    env = make(pattern={**ONE, "direction": [2.0, 0.0, 0.0]})
    assert env.scene["scan"].data.ray_hits_w.isinf().all()
    # A ray caster without drift draws no random numbers.
    assert "env.scene.sensors.scan" not in env.streams.state_dict()["generators"]
    for reach, is_hit in ((0.69, False), (0.71, True)):
        hits = place(make(ray_alignment="yaw", max_distance=reach), [0.0, 0.0, 0.7]).ray_hits_w
        assert hits.isfinite().all() if is_hit else hits.isinf().all()


def test_it_measures_only_once_when_it_is_read(make, monkeypatch):
    env = make(ray_alignment="yaw")
    sensor, measured = env.scene["scan"], []
    sense = sensor.sense
    monkeypatch.setattr(sensor, "sense", lambda ids: (measured.append(ids), sense(ids)))
    env.step(STILL)
    assert measured == []
    first = sensor.data.pos_w.clone()
    assert torch.equal(sensor.data.pos_w, first)
    assert measured == [slice(None)]
    env.reset(env_ids=torch.tensor([2]))
    assert sensor.data.pos_w[2, 2] != first[2, 2]
    assert [ids.tolist() for ids in measured[1:]] == [[2]]


@pytest.mark.parametrize("period", [0.0, 0.04])
def test_with_a_period_the_last_measurement_is_held(make, period):
    env = make(ray_alignment="yaw", update_period=period)
    heights = [env.scene.robot.data.root_pos_w[0, 2].clone()]
    env.scene.robot.write_root_velocity_to_sim(torch.tensor([[0.0, 0.0, 2.0, 0.0, 0.0, 0.0]] * 4), ALL)
    env.scene.refresh()
    for k in range(1, 6):
        env.step(STILL)
        heights.append(env.scene.robot.data.root_pos_w[0, 2].clone())
        if k != 4:
            seen = heights[k] if period == 0.0 else heights[k - k % 2]
            assert float(env.scene["scan"].data.pos_w[0, 2]) == float(seen)


def test_drift_is_drawn_at_resets_within_its_ranges(make):
    env = make(ray_alignment="yaw", drift_range=[-0.2, 0.2], ray_cast_drift_range={"x": [0.5, 0.5], "z": [0.05, 0.1]})
    data = place(env, [0.0, 0.0, 0.7], yaw=math.pi / 2)
    drift = data.pos_w - torch.tensor([0.0, 0.0, 0.7])
    assert drift.abs().max() <= 0.2
    assert len(drift.unique()) == 12
    first = data.ray_hits_w[:, 1]  # The yaw turns this ray from (0, -0.25) to (0.25, 0).
    torch.testing.assert_close(first[:, :2] - drift[:, :2], torch.tensor([[0.25, 0.5]]).expand(4, 2))
    assert ((first[:, 2] >= 0.05) & (first[:, 2] <= 0.1)).all()
    env.step(STILL)
    before = env.scene["scan"].drift.clone()
    env.reset(env_ids=torch.tensor([0]))
    assert (env.scene["scan"].drift[0] != before[0])[[0, 1, 2, 5]].all()
    assert torch.equal(env.scene["scan"].drift[1:], before[1:])


def test_a_held_measurement_changes_at_a_reset_but_not_at_other_writes(make):
    env = make(update_period=1.0)
    start = env.scene["scan"].data.pos_w.clone()
    place(env, [0.0, 0.0, 0.9])
    assert torch.equal(env.scene["scan"].data.pos_w, start)
    env.scene.reset(torch.tensor([1]))
    place(env, [0.0, 0.0, 0.8], ids=torch.tensor([1, 2]))
    assert env.scene["scan"].data.pos_w[:, 2].tolist() == pytest.approx([0.1, 0.8, 0.1, 0.1])
