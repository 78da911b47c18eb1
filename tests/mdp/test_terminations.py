"""Every termination term, compared with values computed by hand."""

import math
from types import SimpleNamespace

import pytest
import torch

from mdp.fakes import entity, fake_env
from wheelleg_exp.mdp import terminations

T = torch.tensor
STILL = torch.zeros(4, 4)


def test_time_runs_out_at_the_longest_length():
    env = fake_env(episode_length_buf=T([9, 10, 11]), max_episode_length=10)
    assert terminations.time_out(env).tolist() == [False, True, True]


def test_a_command_about_to_be_redrawn():
    command = SimpleNamespace(time_left=T([0.01, 0.02, 0.03, 0.01]), command_counter=T([1, 1, 1, 2]))
    env = fake_env(step_dt=0.02, command_manager=SimpleNamespace(get_term=lambda name: command))
    assert terminations.command_resample(env, "v").tolist() == [True, True, False, False]
    assert terminations.command_resample(env, "v", num_resamples=2).tolist() == [False, False, False, True]


def test_tilt():
    gravity = [[math.sin(a), 0.0, -math.cos(a)] for a in (0.0, 0.9, 1.1, -1.1, 3.0)]
    # Rounding can leave the range of acos.
    env = fake_env(data_projected_gravity_b=T([*gravity, [0.0, 0.0, 1.0000002], [0.0, 0.0, -1.0000002]]))
    assert terminations.bad_orientation(env, 1.0).tolist() == [False, False, True, True, True, True, False]


def test_height():
    env = fake_env(data_root_pos_w=T([[0.5, 0.0, 0.6], [1.0, 0.0, 1.3]]), ground=lambda xy: xy[..., 0])
    assert terminations.root_height_below_minimum(env, 0.7).tolist() == [True, False]
    assert terminations.root_height_over_ground_below_minimum(env, 0.2).tolist() == [True, False]


def test_the_edge_of_the_tiles():
    """3 x 2 tiles of 4 m x 5 m and a border of 1 m reach from -7 to 7 m along x, and from -6 to 6 m along y."""
    position = T([[5.9, 0, 0], [-6.1, 0, 0], [0, 4.9, 0], [0, -5.1, 0], [6.1, 5.1, 0]])
    terrain = {"terrain_origins": torch.zeros(3, 2, 3), "size": (4.0, 5.0), "border_width": 1.0}
    env = fake_env(data_root_pos_w=position, terrain=terrain)
    assert terminations.terrain_out_of_bounds(env, distance_buffer=1.0).tolist() == [False, True, False, True, True]
    assert terminations.terrain_out_of_bounds(env).tolist() == [True] * 5
    env.scene.robot.data.root_pos_w = T([[3.9, 0, 0], [4.1, 0, 0], [0, -2.9, 0], [0, 3.1, 0], [4.0, 3.0, 0]])
    # The default buffer is 3 m.
    assert terminations.terrain_out_of_bounds(env).tolist() == [False, True, False, True, False]
    plane = fake_env(data_root_pos_w=position * 1e6, terrain={"terrain_origins": None})
    assert terminations.terrain_out_of_bounds(plane).tolist() == [False] * 5


def test_stuck():
    """Three control steps exceed 0.05 s. Only the second robot is commanded to drive and does not move."""
    command = T([[0.5, 0.0, 0.0], [0.0, -0.5, 0.0], [0.1, 0.0, 9.0], [0.3, 0.4, 0.0]])
    env = fake_env(num_envs=4, device=torch.device("cpu"), step_dt=0.02, commands={"v": command})
    term = terminations.stuck(env, "v", distance=0.1, time=0.05)
    walk = [[0.0, 0.06, 0.12, 0.18, 0.24], [5.0] * 5, [0.0] * 5, [0.0, 0.05, 0.11, 0.2, 0.2]]
    fired = []
    for step in range(5):
        env.scene.robot.data = SimpleNamespace(root_pos_w=T([[line[step], 1.0, 0.1 * step] for line in walk]))
        fired.append(term(env).tolist())
    assert fired == [[False] * 4] * 3 + [[False, True, False, False]] * 2
    term.reset(T([1]))
    assert [term(env)[1].item() for _ in range(4)] == [False, False, False, True]


JOINTS = {
    "data_joint_pos": T([[0.5, 0.0], [0.2, -2.0], [0.0, 0.0]]),
    "data_joint_vel": T([[3.0, 0.0], [0.0, -1.5], [1.0, 0.0]]),
    "data_soft_joint_pos_limits": T(3 * [[[-0.3, 0.3], [-math.inf, math.inf]]]),
    "data_soft_joint_vel_limits": T(3 * [[2.0, 1.0]]),
}


@pytest.mark.parametrize(
    ("name", "fields", "expected"),
    [
        ("pos_out_of_limit", {}, [True, False, False]),
        ("pos_out_of_manual_limit", {"bounds": (-1.0, 0.4)}, [True, True, False]),
        ("pos_out_of_manual_limit", {"bounds": (-1.0, 0.4), "asset_cfg": entity(joints=[1])}, [False, True, False]),
        ("vel_out_of_limit", {}, [True, True, False]),
        ("vel_out_of_manual_limit", {"max_velocity": 2.0}, [True, False, False]),
        ("vel_out_of_manual_limit", {"max_velocity": 1.2}, [True, True, False]),
    ],
)
def test_positions_and_velocities_of_joints(name, fields, expected):
    assert getattr(terminations, f"joint_{name}")(fake_env(**JOINTS), **fields).tolist() == expected


def test_a_value_at_its_limit_is_not_beyond_it():
    half = 0.5  # which float32 has
    env = fake_env(
        data_root_pos_w=T([[0.0, 0.0, half]]),
        data_projected_gravity_b=T([[1.0, 0.0, 0.0]]),
        data_joint_pos=T([[half, -half]]),
        data_joint_vel=T([[half, -half]]),
        data_soft_joint_pos_limits=T([[[-half, half], [-half, half]]]),
        data_soft_joint_vel_limits=T([[half, half]]),
        ground=lambda xy: 0.0 * xy[..., 0],
    )
    for found in (
        terminations.root_height_below_minimum(env, half),
        terminations.root_height_over_ground_below_minimum(env, half),
        terminations.bad_orientation(env, math.pi / 2),
        terminations.joint_pos_out_of_limit(env),
        terminations.joint_pos_out_of_manual_limit(env, bounds=(-half, half)),
        terminations.joint_vel_out_of_limit(env),
        terminations.joint_vel_out_of_manual_limit(env, max_velocity=half),
    ):
        assert found.tolist() == [False]


def test_contacts():
    env = fake_env(contact_norm=T([[0.0, 2.0], [0.3, 0.0], [0.31, 0.0]]))
    assert terminations.illegal_contact(env, 0.3, entity("contact")).tolist() == [True, False, True]
    assert terminations.illegal_contact(env, 0.3, entity("contact", bodies=[0])).tolist() == [False, False, True]


def test_a_torque_is_out_of_its_limit_where_less_is_applied_than_was_computed():
    """The last two rows are torques below the limit that are clipped, and that differ only by rounding."""
    computed = T([[3.0, -1.0], [4.5, 0.0], [0.0, -4.5], [4.0, -4.0], [3.0, 1.0], [3.0, 0.0004]])
    applied = T([[3.0, -1.0], [4.0, 0.0], [0.0, -4.0], [4.0, -4.0], [2.5, 1.0], [3.0003, 0.0]])
    limits = torch.full((6, 2), 4.0)
    env = fake_env(data_computed_torque=computed, data_applied_torque=applied, data_joint_effort_limits=limits)
    assert terminations.joint_effort_out_of_limit(env).tolist() == [False, True, True, False, True, False]
    second = terminations.joint_effort_out_of_limit(env, entity(joints=[1]))
    assert second.tolist() == [False, False, True, False, False, False]


@pytest.mark.parametrize("field", ["qvel", "qpos"])
def test_a_state_that_breaks_in_the_last_physics_step_is_noticed_at_once(start_env, field, tmp_path, monkeypatch):
    """The engine checks a state only when the next step starts from this state."""
    monkeypatch.chdir(tmp_path)
    env = start_env(terminations={"t": {"_target_": "wheelleg_exp.mdp.terminations.non_finite_state"}})
    step, count = env.scene.sim.step, iter(range(100))

    def breaking_step():
        step()
        if next(count) == 1:
            env.scene.sim.view(field)[2, 8] = math.nan

    env.scene.sim.step = breaking_step
    obs, _, terminated, _, _ = env.step(STILL)
    assert terminated.tolist() == [False, False, True, False]
    assert obs["policy"].isfinite().all()
