"""Actions: mapped to limits, averaged, binary, and delayed, compared with values computed by hand."""

import pytest
import torch

A = "wheelleg_exp.mdp.actions."
approx = pytest.approx
UNSPREAD = {"rescale_to_limits": False}
HIPS = [".*_hip"]  # The limits [-1, 1.5] rad have the middle .25 and the half range 1.25.


def _env(start_env, /, **node):
    env = start_env(actions={"a": {**node, "_target_": A + node["_target_"]}})
    return env, env.action_manager, env.action_manager.get_term("a")


def _processed(manager, term, *raw):
    manager.process_action(torch.tensor([list(raw)] * 4))
    return term.processed_actions[0].tolist()


def _targets(env):
    env.action_manager.apply_action()
    return env.scene.robot.data.joint_pos_target[0].tolist()


def test_actions_between_minus_one_and_one_are_spread_over_the_soft_limits(start_env):
    env, manager, term = _env(start_env, _target_="JointPositionToLimitsAction", joint_names=HIPS, scale=0.5)
    assert _processed(manager, term, 0.0, 1.0) == pytest.approx([0.25, 0.875])  # .25 + 1.25 * .5
    assert _processed(manager, term, 7.0, -2.5) == pytest.approx([1.5, -1.0])
    assert (term.raw_actions[0].tolist(), _targets(env)[:2]) == ([7.0, -2.5], pytest.approx([1.5, -1.0]))


@pytest.mark.parametrize(
    ("node", "raw", "expected"),
    [
        ({"joint_names": HIPS, "clip": {"left_.*": [-0.2, 0.4]}}, [1.0, 1.0], approx([0.75, 1.5])),  # .25 + 1.25 * .4
        (UNSPREAD | {"joint_names": [".*"], "scale": {".*_hip": 3.0}}, [1.0, -1.0, 5.0, 6.0], [3.0, -3.0, 5.0, 6.0]),
    ],
)
def test_clipping_comes_before_an_optional_spreading(start_env, node, raw, expected):
    _, manager, term = _env(start_env, _target_="JointPositionToLimitsAction", **node)
    assert _processed(manager, term, *raw) == expected


def test_actions_use_the_current_limits(start_env):
    env, manager, term = _env(start_env, _target_="JointPositionToLimitsAction", joint_names=HIPS)
    env.scene.robot.data.soft_joint_pos_limits[..., :2, :] = torch.tensor([0.0, 2.0])
    assert _processed(manager, term, -1.0, 0.5) == pytest.approx([0.0, 1.5])


def test_preserve_order_applies_when_the_term_covers_all_joints(start_env):
    names = ["right_axle", "left_axle", "right_hip", "left_hip"]
    node = {"_target_": "JointPositionToLimitsAction", "rescale_to_limits": False, "preserve_order": True}
    env, manager, term = _env(start_env, **node, joint_names=names)
    _processed(manager, term, 1.0, 2.0, 3.0, 4.0)
    assert _targets(env) == [4.0, 3.0, 2.0, 1.0]


def test_the_average_starts_at_the_joints_and_continues_from_the_last_target(start_env):
    node = {"_target_": "EMAJointPositionToLimitsAction", "joint_names": HIPS, "alpha": {"left_.*": 0.25}}
    _, manager, term = _env(start_env, **node)
    # Hips start at .2. The left hip takes a quarter of 1.5, and the right hip, which has no alpha, takes all of 1.5.
    assert _processed(manager, term, 1.0, 1.0) == pytest.approx([0.75 * 0.2 + 0.25 * 1.5, 1.5])
    assert _processed(manager, term, -1.0, -1.0) == pytest.approx([0.75 * 0.525 - 0.25, -1.0])


def test_an_average_stays_within_the_limits(start_env):
    node = {"_target_": "EMAJointPositionToLimitsAction", "joint_names": HIPS, "alpha": 0.5}
    _, manager, term = _env(start_env, **node, rescale_to_limits=False)
    assert _processed(manager, term, 10.0, -10.0) == [1.5, -1.0]


def test_a_reset_restarts_the_average_at_the_new_position_of_its_environments(start_env):
    node = {"_target_": "EMAJointPositionToLimitsAction", "joint_names": HIPS, "alpha": 0.0}
    env, manager, term = _env(start_env, **node)
    ids = torch.tensor([2])
    env.scene.robot.write_joint_state_to_sim(torch.full((1, 4), 0.7), torch.zeros(1, 4), env_ids=ids)
    manager.reset(ids)
    manager.process_action(torch.zeros(4, 2))
    assert term.processed_actions[:, 0].tolist() == pytest.approx([0.2, 0.2, 0.7, 0.2])


TWO = {"open_command_expr": {"left_.*": 0.5, "right_.*": 0.6}, "close_command_expr": {".*": -0.5}}


@pytest.mark.parametrize(
    ("kind", "fields", "raw", "opens"),
    [
        ("Binary", {}, [0.0, -0.01, 3.0], [True, False, True]),
        ("AbsBinary", {}, [0.5, 0.51, -1.0], [False, True, False]),
        ("AbsBinary", {"threshold": 0.2, "positive_threshold": False}, [0.2, 0.1, 0.3], [False, True, False]),
    ],
)
def test_one_number_opens_or_closes_all_joints(start_env, kind, fields, raw, opens):
    env, manager, term = _env(start_env, _target_=f"{kind}JointPositionAction", joint_names=HIPS, **TWO, **fields)
    assert manager.total_action_dim == 1
    for number, is_open in zip(raw, opens, strict=True):
        expected = pytest.approx([0.5, 0.6] if is_open else [-0.5, -0.5])
        assert (_processed(manager, term, number), _targets(env)[:2]) == (expected, expected)


def test_binary_velocities_are_clipped_and_their_raw_actions_zeroed(start_env):
    node = {"_target_": "BinaryJointVelocityAction", "joint_names": [".*_axle"], "clip": {"left_axle": [-1.0, 1.0]}}
    env, manager, term = _env(start_env, **node, open_command_expr={".*": 3.0}, close_command_expr={".*": -3.0})
    assert _processed(manager, term, 1.0) == [1.0, 3.0]
    manager.apply_action()
    assert env.scene.robot.data.joint_vel_target[0].tolist() == [0.0, 0.0, 1.0, 3.0]
    manager.reset(torch.tensor([1]))
    assert term.raw_actions.flatten().tolist() == [1, 0, 1, 1]


def _delayed(start_env, lags):
    node = {"_target_": A + "JointPositionAction", "joint_names": HIPS, "use_default_offset": False, "delay": lags}
    return start_env(actions={"a": node})


def test_a_delay_counts_physics_steps(start_env):
    """The delay is three physics steps, and a control step has two physics steps."""
    env = _delayed(start_env, [3, 3])
    seen, write = [], env.scene.write_data_to_sim

    def spy():
        seen.append(env.scene.robot.data.joint_pos_target[0, 0].item())
        write()

    env.scene.write_data_to_sim = spy
    for action in (0.1, 0.2, 0.3, 0.4):
        env.step(torch.full((4, 2), action))
        assert env.action_manager.get_term("a").processed_actions[0, 0].item() == pytest.approx(action)
    #            steps      0    1    2    3    4    5    6    7
    assert seen == pytest.approx([0.1, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.3])


def test_a_new_episode_has_no_actions_of_the_last(start_env):
    env = _delayed(start_env, [4, 4])
    env.step(torch.ones(4, 2))
    env.reset(env_ids=torch.tensor([1]))
    env.step(torch.full((4, 2), 0.5))
    assert env.scene.robot.data.joint_pos_target[:, 0].tolist() == [1.0, 0.5, 1.0, 1.0]


def test_without_a_delay_nothing_is_saved(start_env):
    for lags in (None, [0, 0]):
        assert "delays" not in _delayed(start_env, lags).action_manager.state_dict()
