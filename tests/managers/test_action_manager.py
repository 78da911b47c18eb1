"""Actions: what raw actions become and when."""

import pytest
import torch

from wheelleg_exp.errors import WheellegError

A = "wheelleg_exp.mdp.actions."


def _env(start_env, robot="rover", **nodes):
    return start_env(robot, actions={n: {**node, "_target_": A + node["_target_"]} for n, node in nodes.items()})


def _position(**fields):
    return {"_target_": "JointPositionAction", "joint_names": [".*_hip"], "use_default_offset": False} | fields


def _apply(env, *action):
    env.action_manager.process_action(torch.tensor([action] * 4))
    env.action_manager.apply_action()
    return env.scene.robot.data


def test_scale_comes_first_then_offset_then_clip(start_env):
    env = _env(start_env, a=_position(scale=2.0, offset=0.5, clip={".*": [-1.0, 3.0]}))
    env.action_manager.process_action(torch.tensor([[1.0, -2.0]] * 4))
    term = env.action_manager.get_term("a")
    # 1*2 + .5 = 2.5, and -2*2 + .5 = -3.5 is clipped to -1. Clipping the raw action would give other values.
    assert (term.processed_actions[0].tolist(), term.raw_actions[0].tolist()) == ([2.5, -1.0], [1.0, -2.0])


def test_numbers_by_expression_leave_other_joints_alone(start_env):
    node = {"_target_": "JointVelocityAction", "joint_names": [".*"], "use_default_offset": False}
    node |= {"scale": {".*_axle": 3.0}, "offset": {"left_hip": 0.25}, "clip": {"right_axle": [-1.0, 1.0]}}
    env = _env(start_env, a=node)
    env.action_manager.process_action(torch.full((4, 4), 2.0))
    # left_hip, right_hip, left_axle, right_axle
    assert env.action_manager.get_term("a").processed_actions[0].tolist() == [2.25, 2.0, 6.0, 1.0]


@pytest.mark.parametrize(("preserve", "expected"), [(True, [2.0, 1.0]), (False, [1.0, 2.0])])
def test_preserve_order_uses_the_order_of_the_expressions(start_env, preserve, expected):
    env = _env(start_env, a=_position(joint_names=["right_hip", "left_hip"], preserve_order=preserve))
    assert _apply(env, 1.0, 2.0).joint_pos_target[0, :2].tolist() == expected


def test_the_default_position_is_the_offset_of_a_position_action(start_env):
    data = _apply(_env(start_env, a=_position(use_default_offset=True, scale=0.5)), 1.0, 0.0)
    assert data.joint_pos_target[0, :2].tolist() == pytest.approx([0.7, 0.2])


def test_a_velocity_action_sets_velocity_targets_within_the_velocity_limit(start_env):
    env = _env(start_env, a={"_target_": "JointVelocityAction", "joint_names": [".*_axle"], "scale": 10.0})
    assert _apply(env, 1.0, -5.0).joint_vel_target[0].tolist() == [0, 0, 10, -20]


def test_the_default_velocity_is_the_offset_of_a_velocity_action(make_env):
    init = {"pos": [0, 0, 1], "rot": [1, 0, 0, 0], "joint_pos": {}, "joint_vel": {"left_axle": 1.5}}
    node = {"_target_": A + "JointVelocityAction", "joint_names": [".*_axle"], "scale": 2.0, "use_default_offset": True}
    env = make_env(actions={"a": node}, robot={"init_state": init})
    assert _apply(env, 1.0, 1.0).joint_vel_target[0, 2:].tolist() == [3.5, 2.0]


def test_an_effort_action_sets_efforts_and_moves_the_joint(start_env):
    env = _env(start_env, "arm", a={"_target_": "JointEffortAction", "joint_names": ["hinge"], "scale": 2.0})
    env.step(torch.full((4, 1), 1.5))
    assert env.scene.robot.data.joint_effort_target[0].tolist() == [3.0, 0.0]


def test_a_relative_action_adds_to_the_position_at_each_physics_step(start_env):
    env = _env(start_env, a={"_target_": "RelativeJointPositionAction", "joint_names": [".*_hip"], "scale": 0.5})
    robot = env.scene.robot
    seen, write = [], env.scene.write_data_to_sim

    def spy():
        seen.append((robot.data.joint_pos[:, :2].clone(), robot.data.joint_pos_target[:, :2].clone()))
        write()

    env.scene.write_data_to_sim = spy
    env.step(torch.tensor([[1.0, -1.0]] * 4))
    assert len(seen) == 2
    for position, target in seen:
        torch.testing.assert_close(target, position + torch.tensor([0.5, -0.5]))
    assert not torch.equal(seen[0][1], seen[1][1])


def test_a_relative_action_takes_an_offset_only_without_zero_offset(start_env):
    node = {"_target_": "RelativeJointPositionAction", "joint_names": [".*_hip"], "offset": 0.3}
    for zero, expected in ((True, 0.0), (False, 0.3)):
        env = _env(start_env, a=node | {"use_zero_offset": zero})
        env.action_manager.process_action(torch.zeros(4, 2))
        assert env.action_manager.get_term("a").processed_actions[0].tolist() == pytest.approx([expected] * 2)


def test_position_and_velocity_terms_of_one_joint_write_their_own_targets(start_env):
    env = _env(start_env, p=_position(), v={"_target_": "JointVelocityAction", "joint_names": [".*_hip"]})
    data = _apply(env, 0.1, 0.2, 3.0, 4.0)
    assert data.joint_pos_target[0, :2].tolist() == pytest.approx([0.1, 0.2])
    assert data.joint_vel_target[0, :2].tolist() == [3.0, 4.0]


def test_terms_take_their_slices_in_the_order_of_the_config(start_env):
    env = _env(start_env, b={"_target_": "JointVelocityAction", "joint_names": [".*_axle"]}, a=_position())
    assert (env.action_manager.total_action_dim, env.action_manager.action_term_dim) == (4, [2, 2])
    env.action_manager.process_action(torch.tensor([[1.0, 2.0, 3.0, 4.0]] * 4))
    assert env.action_manager.get_term("b").raw_actions[0].tolist() == [1, 2]
    assert env.action_manager.get_term("a").raw_actions[0].tolist() == [3, 4]


def test_the_last_two_raw_actions_are_stored_unclipped(start_env):
    env = _env(start_env, a=_position(clip={".*": [-1.0, 1.0]}))
    action = torch.full((4, 2), 50.0)
    env.action_manager.process_action(action)
    action.fill_(70.0)  # the manager has its own copy of an action
    env.action_manager.process_action(action)
    assert (env.action_manager.action == 70).all()
    assert (env.action_manager.prev_action == 50).all()


def test_a_reset_zeroes_the_actions_of_its_environments_and_leaves_processed_ones(start_env):
    env = _env(start_env, a=_position())
    for _ in range(2):
        env.action_manager.process_action(torch.ones(4, 2))
    env.action_manager.reset(torch.tensor([0, 3]))
    manager, term = env.action_manager, env.action_manager.get_term("a")
    for stored in (manager.action, manager.prev_action, term.raw_actions):
        assert stored.sum(dim=1).tolist() == [0, 2, 2, 0]
    assert (term.processed_actions == 1).all()


@pytest.mark.parametrize("shape", [(4, 1), (1, 2), (2,), (4, 3), (3, 2)])
def test_an_action_of_a_wrong_shape_is_rejected(start_env, shape):
    env = _env(start_env, a=_position())
    with pytest.raises((ValueError, WheellegError), match="action"):
        env.step(torch.zeros(shape))
