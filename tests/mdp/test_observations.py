"""Every observation against numbers worked out by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from mdp.fakes import entity, fake_env
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.mdp import observations

T = torch.tensor

ENV = fake_env(
    env_origins=T([[1.0, 2.0, 0.0], [0.0, 0.0, 0.5]]),
    data_root_pos_w=T([[1.5, 2.0, 0.3], [0.0, 1.0, 0.75]]),
    data_root_quat_w=T([[-0.6, 0.8, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]),
    data_joint_pos=T([[0.5, 1.0, 3.0], [0.0, 0.0, 0.0]]),
    data_default_joint_pos=T([[0.25, 1.0, 0.0], [0.1, 0.0, 0.0]]),
    data_joint_vel=T([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]),
    data_default_joint_vel=T([[0.5, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    data_soft_joint_pos_limits=T(2 * [[[-0.5, 1.5], [-1.0, 1.0], [0.0, 4.0]]]),
    data_applied_torque=T([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
    episode_length_buf=T([0, 50]),
    step_dt=0.02,
    max_episode_length_s=5.0,
)


def close(got, expected):
    torch.testing.assert_close(got, T(expected), atol=1e-6, rtol=1e-6)


def test_height_is_in_the_world_and_position_is_from_the_environments_origin():
    close(observations.base_pos_z(ENV), [[0.3], [0.75]])
    close(observations.root_pos_w(ENV), [[0.5, 0.0, 0.3], [0.0, 1.0, 0.25]])


def test_orientation_may_be_made_unique():
    close(observations.root_quat_w(ENV), [[-0.6, 0.8, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    close(observations.root_quat_w(ENV, make_quat_unique=True), [[0.6, -0.8, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])


def test_joints():
    first = entity(joints=[0])
    close(observations.joint_pos(ENV, asset_cfg=first), [[0.5], [0.0]])
    close(observations.joint_pos_rel(ENV), [[0.25, 0.0, 3.0], [-0.1, 0.0, 0.0]])
    close(observations.joint_vel(ENV, asset_cfg=first), [[1.0], [0.0]])
    close(observations.joint_vel_rel(ENV), [[0.5, 2.0, 3.0], [0.0, 0.0, -1.0]])
    close(observations.joint_effort(ENV, asset_cfg=entity(joints=[2, 0])), [[3.0, 1.0], [6.0, 4.0]])


def test_positions_between_their_limits():
    close(observations.joint_pos_limit_normalized(ENV)(ENV), [[0.0, 1.0, 0.5], [-0.5, 0.0, -1.0]])


def test_angles_as_sines_and_cosines():
    close(
        observations.joint_pos_sin_cos(ENV, asset_cfg=entity(joints=[0, 2])),
        [[math.sin(0.5), math.sin(3), math.cos(0.5), math.cos(3)], [0.0, 0.0, 1.0, 1.0]],
    )


def test_times():
    close(observations.current_time_s(ENV), [[0.0], [1.0]])
    close(observations.remaining_time_s(ENV), [[5.0], [4.0]])


def test_velocities_are_those_of_the_robot():
    names = {
        observations.base_lin_vel: "root_lin_vel_b",
        observations.base_ang_vel: "root_ang_vel_b",
        observations.root_link_lin_vel: "root_link_lin_vel_b",
        observations.projected_gravity: "projected_gravity_b",
        observations.root_lin_vel_w: "root_lin_vel_w",
        observations.root_ang_vel_w: "root_ang_vel_w",
    }
    for k, (function, name) in enumerate(names.items()):
        fields = {f"data_{other}": torch.full((2, 3), float(i)) for i, other in enumerate(names.values())}
        assert (function(fake_env(**fields)) == k).all(), name


def test_actions_of_all_terms_or_one():
    term = SimpleNamespace(raw_actions=T([[7.0]]))
    manager = SimpleNamespace(action=T([[1.0, 2.0]]), get_action_term=lambda name: {"legs": term}[name])
    env = fake_env(action_manager=manager)
    close(observations.last_action(env), [[1.0, 2.0]])
    close(observations.last_action(env, action_name="legs"), [[7.0]])


def test_an_unlimited_joint_has_no_place_between_limits(make_env):
    node = {"_target_": "wheelleg_exp.mdp.observations.joint_pos_limit_normalized"}
    with pytest.raises(WheellegError, match=r"left_axle|limit"):
        make_env(observations={"policy": {"terms": {"x": node}}})
