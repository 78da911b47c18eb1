"""Every reward term, compared with values computed by hand."""

import math
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from mdp.fakes import close, entity, fake_env
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.mdp import rewards

T = torch.tensor
TWO = {"num_envs": 2, "device": torch.device("cpu")}


def _ends(terminated, time_outs, **fired):
    manager = SimpleNamespace(
        terminated=T(terminated), time_outs=T(time_outs), active_terms=list(fired), get_term=lambda name: T(fired[name])
    )
    return fake_env(termination_manager=manager)


def test_a_time_out_counts_as_alive_and_not_as_terminated():
    env = _ends([True, False, False, True], [False, True, False, True])
    close(rewards.is_alive(env), [0, 1, 1, 0])
    close(rewards.is_terminated(env), [1, 0, 0, 1])


def test_terminated_by_terms_counts_them_and_is_nothing_on_a_time_out():
    fired = {"fall": [True, True, False, True], "hit": [True, False, False, True], "time": [False, False, True, True]}
    env = _ends([True, True, False, True], [False, False, True, True], **fired)
    close(rewards.is_terminated_term(env)(env), [2, 1, 0, 0])
    close(rewards.is_terminated_term(env, "hit")(env), [1, 0, 0, 0])
    close(rewards.is_terminated_term(env, ["fall", "h.*"])(env), [2, 1, 0, 0])


VELOCITY = {
    "data_root_lin_vel_b": T([[1.0, 2.0, 3.0], [0.0, -1.0, -2.0]]),
    "data_root_ang_vel_b": T([[0.5, -1.0, 4.0], [0.0, 0.0, -0.5]]),
}
GRAVITY = {"data_projected_gravity_b": T([[0.6, 0.0, -0.8], [0.3, 0.4, -0.86]])}
HEIGHTS = {"data_root_pos_w": T([[9.0, 9.0, 0.5], [9.0, 9.0, 0.1]])}
ACTIONS = SimpleNamespace(action=T([[1.0, 2.0], [0.0, 0.0]]), prev_action=T([[0.0, 4.0], [3.0, 0.0]]))


@pytest.mark.parametrize(
    ("function", "fields", "expected"),
    [
        (rewards.lin_vel_z_l2, VELOCITY, [9, 4]),
        (rewards.ang_vel_xy_l2, VELOCITY, [1.25, 0]),
        (rewards.flat_orientation_l2, GRAVITY, [0.36, 0.25]),
        (partial(rewards.flat_orientation_exp, std=0.5), GRAVITY, [math.exp(-1.44), math.exp(-1.0)]),
        (rewards.pitch_orientation_l2, GRAVITY, [0.36, 0.09]),
        (rewards.upward, GRAVITY, [1.8**2, 1.86**2]),
        (partial(rewards.base_height_l2, target_height=0.3), HEIGHTS, [0.04, 0.04]),
        (rewards.action_rate_l2, {"action_manager": ACTIONS}, [5, 9]),
        (rewards.action_l2, {"action_manager": ACTIONS}, [5, 0]),
    ],
)
def test_a_formula_by_hand(function, fields, expected):
    close(function(fake_env(**fields)), expected)


def test_heights_are_measured_from_the_ground_below():
    """The ground is a formula of the position, or the rays' hits."""
    positions = T([[9.0, 9.0, 0.5], [9.0, 9.0, 0.52], [1.0, 9.0, 0.5]])
    env = fake_env(data_root_pos_w=positions, ground=lambda xy: torch.where(xy[..., 0] > 5.0, 0.2, 0.16))
    close(rewards.base_height_exp(env, target_height=0.3, std=0.02), [1.0, math.exp(-1.0), math.exp(-4.0)])
    positions = T([[1.0, 2.0, 2.5], [0.0, 0.0, 0.1]])
    env = fake_env(data_root_pos_w=positions, ground=lambda xy: 0.1 * xy[..., 0] + xy[..., 1])
    close(rewards.base_height_over_ground_l2(env, target_height=0.3), [0.01, 0.04])
    env = fake_env(data_root_pos_w=T([[9.0, 9.0, 0.5]] * 3))
    hits = T([[[0.0, 0.0, 0.1], [5.0, 5.0, 0.3]], [[0.0, 0.0, 0.2]] * 2, [[0.0, 0.0, 0.0], [0.0, 0.0, math.inf]]])
    env.scene["rays"] = SimpleNamespace(data=SimpleNamespace(ray_hits_w=hits))
    close(rewards.base_height_l2(env, target_height=0.2, sensor_cfg=entity("rays")), [0.01, 0.01, math.inf])


def test_norms_of_accelerations_add_up():
    env = fake_env(data_body_lin_acc_w=T([[[3.0, 4.0, 0.0], [0.0, 0.0, -2.0]], [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]))
    close(rewards.body_lin_acc_norm_sum(env), [7, 1])
    close(rewards.body_lin_acc_norm_sum(env, entity(bodies=[0])), [5, 0])


JOINTS = {
    "data_joint_pos": T([[0.5, -1.0, 2.0], [0.0, 0.0, 0.0]]),
    "data_default_joint_pos": T([[0.0, -1.5, 2.0], [0.1, 0.0, 0.0]]),
    "data_joint_vel": T([[1.0, -2.0, 0.5], [0.0, 3.0, 0.0]]),
    "data_joint_acc": T([[10.0, 0.0, -2.0], [0.0, 0.0, 0.0]]),
    "data_applied_torque": T([[1.0, -2.0, 0.0], [0.0, 0.5, 0.0]]),
    "data_computed_torque": T([[1.0, -5.0, 0.0], [0.0, 0.5, 1.0]]),
    "data_soft_joint_pos_limits": T(2 * [[[-0.25, 0.25], [-0.75, 1.0], [-math.inf, math.inf]]]),
    "data_soft_joint_vel_limits": T(2 * [[1.0, 1.0, math.inf]]),
}


@pytest.mark.parametrize(
    ("function", "all_joints", "last_two"),
    [
        (rewards.joint_torques_l2, [5, 0.25], [4, 0.25]),
        (rewards.joint_power, [5, 1.5], [4, 1.5]),
        (rewards.joint_vel_l1, [3.5, 3], [2.5, 3]),
        (rewards.joint_vel_l2, [5.25, 9], [4.25, 9]),
        (rewards.joint_acc_l2, [104, 0], [4, 0]),
        (rewards.joint_deviation_l1, [1, 0.1], [0.5, 0]),
        (rewards.joint_pos_limits, [0.5, 0], [0.25, 0]),
        (rewards.applied_torque_limits, [3, 1], [3, 1]),
    ],
)
def test_sums_over_joints(function, all_joints, last_two):
    close(function(fake_env(**JOINTS)), all_joints)
    close(function(fake_env(**JOINTS), asset_cfg=entity(joints=[1, 2])), last_two)


def test_speeds_differences_and_power_of_joints():
    env = fake_env(**JOINTS)
    # Each speed beyond its limit is cut at 1: .1 + 1 (of 1.1), and 1 (of 2.1).
    close(rewards.joint_vel_limits(env, soft_ratio=0.9), [1.1, 1.0])
    close(rewards.joint_symmetry_l1(env, entity(joints=[0, 1]), entity(joints=[2, 2])), [4.5, 0.0])
    close(rewards.joint_symmetry_l1(env, entity(joints=[0]), entity(joints=[1]), mirrored=True), [0.5, 0.0])  # not 1.5
    env = fake_env(**JOINTS | {"data_joint_vel": T([[1.0, 2.0, 0.5], [0.0, 3.0, 0.0]])})
    close(rewards.joint_power(env), [5, 1.5])
    close(rewards.joint_power(env, positive_only=True), [1, 1.5])


def test_the_pose_counts_while_the_command_is_zero():
    env = fake_env(**JOINTS, commands={"v": T([[0.06, 0.0, 9.0], [0.03, 0.05, 9.0]])})
    close(rewards.stand_still_joint_deviation_l1(env, "v"), [0, 0.1])
    close(rewards.stand_still_joint_deviation_l1(env, "v", command_threshold=0.07), [1, 0.1])


def test_velocities_are_compared_with_the_last_step_of_the_episode():
    env = fake_env(data_joint_vel=T([[1.0, 9.0], [2.0, 9.0]]), **TWO)
    term = rewards.joint_vel_rate_l2(env, entity(joints=[0]))
    close(term(env), [0, 0])
    env.scene.robot.data.joint_vel = T([[3.0, 0.0], [1.0, 0.0]])
    close(term(env), [4, 1])
    term.reset(T([1]))
    env.scene.robot.data.joint_vel = T([[3.5, 0.0], [7.0, 0.0]])
    close(term(env), [0.25, 0])


def test_second_differences_of_actions_restart_with_an_episode():
    steps = [T([[1.0, 0.0], [2.0, 1.0]]), T([[1.0, 2.0], [0.0, 1.0]]), T([[4.0, 2.0], [1.0, 0.0]])]
    manager = SimpleNamespace(action=steps[0], prev_action=torch.zeros(2, 2))
    env = fake_env(action_manager=manager)
    term = rewards.action_acceleration_l2(env)
    close(term(env), [1, 5])
    manager.action, manager.prev_action = steps[1], steps[0]
    close(term(env), [1 + 4, 16 + 1])  # (1 - 2, 2), (0 - 4, 1 - 2)
    term.reset(T([1]))
    manager.action, manager.prev_action = steps[2], T([[1.0, 2.0], [0.0, 0.0]])
    close(term(env), [9 + 4, 1])  # (4 - 2 + 1, 2 - 4 + 0), (1, 0)


@pytest.mark.parametrize(
    ("function", "threshold", "all_bodies", "first_two"),
    [
        (rewards.undesired_contacts, 1.0, [2, 0], [1, 0]),
        (rewards.no_contact_count, 1.0, [1, 3], [1, 2]),
        (rewards.no_desired_contact, 1.0, [0, 1], [0, 1]),
        (rewards.no_desired_contact, 3.0, [0, 1], [1, 1]),
        (rewards.contact_forces, 0.75, [5.5, 0.5], [1.25, 0.25]),
    ],
)
def test_contacts(function, threshold, all_bodies, first_two):
    env = fake_env(contact_norm=T([[0.0, 2.0, 5.0], [0.5, 1.0, 1.0]]))
    close(function(env, threshold=threshold, sensor_cfg=entity("contact")), all_bodies)
    close(function(env, threshold=threshold, sensor_cfg=entity("contact", bodies=[0, 1])), first_two)


def test_tracking_in_the_axes_of_the_base():
    env = fake_env(**VELOCITY, commands={"v": T([[1.0, 1.5, 4.5], [0.0, -1.0, -0.5]])})
    close(rewards.track_lin_vel_xy_exp(env, std=0.5, command_name="v"), [math.exp(-0.25 / 0.25), 1.0])
    close(rewards.track_ang_vel_z_exp(env, std=0.25, command_name="v"), [math.exp(-0.25 / 0.0625), 1.0])


def test_tracking_in_level_axes():
    """The robot has a yaw of 0.6 rad, and moves at 1.5 m/s forwards and 0.5 m/s to its left."""
    cos, sin = math.cos(0.6), math.sin(0.6)
    env = fake_env(
        data_root_lin_vel_w=T([[1.5 * cos - 0.5 * sin, 1.5 * sin + 0.5 * cos, 7.0]]),
        data_root_ang_vel_w=T([[9.0, 9.0, 1.5]]),
        data_heading_w=T([0.6]),
        commands={"v": T([[1.75, 0.375, 1.0]])},
    )
    error = 0.25**2 + 0.125**2
    close(rewards.track_lin_vel_xy_yaw_frame_exp(env, std=0.5, command_name="v"), [math.exp(-error / 0.25)])
    close(rewards.track_ang_vel_z_world_exp(env, std=0.5, command_name="v"), [math.exp(-0.25 / 0.25)])


def test_tracking_height_and_tilt():
    """A pitch of 0.3 rad gives gravity a component sin 0.3 along x, and a roll of 0.2 rad one of -sin 0.2 along y."""
    gravity = [[math.sin(0.3), 0.0, -math.cos(0.3)], [0.0, -math.sin(0.2), -math.cos(0.2)], [-1.0000001, 0.0, -0.0]]
    env = fake_env(
        data_root_pos_w=T([[0.0, 0.0, 0.35], [0.0, 1.0, 1.3], [0.0, 0.0, 0.0]]),
        data_projected_gravity_b=T(gravity),
        ground=lambda xy: xy[..., 1],
        commands={"p": T([[0.25, 0.0, 0.1], [0.3, 0.5, 0.4], [0.0, 0.0, -math.pi / 2]])},
    )
    close(rewards.track_base_height_exp(env, std=0.2, command_name="p"), [math.exp(-0.25), 1, 1])
    expected = [math.exp(-0.04 / 0.16), math.exp(-0.25 / 0.16), 1]
    close(rewards.track_base_tilt_exp(env, std=0.4, command_name="p"), expected)


def test_only_an_upright_robot_of_the_right_height_stands():
    env = fake_env(
        data_root_pos_w=T([[0.0, 0.0, 0.5], [0.0, 0.0, 0.6], [0.0, 0.0, 0.5], [0.0, 0.0, 0.5]]),
        data_projected_gravity_b=T([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, 0.0, 1.0]]),
    )
    expected = [1.0, math.exp(-0.25), math.exp(-4.0), 0.0]
    close(rewards.standing_exp(env, target_height=0.5, height_std=0.2, tilt_std=0.3), expected)


def test_a_jump_earns_its_largest_clearance_once():
    """A ballistic jump with a take-off speed v reaches v²/2g, and the reward sums to this height over the jump."""
    dt, speed = 0.01, 1.0
    command = T([[1.0], [1.0]])
    env = fake_env(commands={"jump": command}, data_body_pos_w=torch.zeros(2, 2, 3), step_dt=dt, **TWO)
    term = rewards.jump_clearance(env, "jump", rest=0.02, target=0.03, asset_cfg=entity(bodies=[0, 1]))
    total = torch.zeros(2)
    for step in range(40):
        time = step * dt
        height = max(0.0, speed * time - 9.81 * time**2 / 2)
        # The first robot lifts only one wheel; the second jumps higher than the target.
        env.scene.robot.data.body_pos_w[:, :, 2] = 0.02 + T([[height, 0.0], [height, height]])
        total += term(env) * dt
    assert speed**2 / (2 * 9.81) > 0.03
    close(total, [0.0, 0.03])
    command.zero_()
    assert term(env).tolist() == [0.0, 0.0]
    env.scene.robot.data.body_pos_w[:, :, 2] = 0.03
    assert term(env).tolist() == [0.0, 0.0]  # Outside the command's window, a jump earns nothing.
    command.fill_(0.5)
    env.scene.robot.data.body_pos_w[0, :, 2] = math.nan
    close(term(env)[1:] * dt, [0.01])
    term.reset(torch.tensor([0]))
    env.scene.robot.data.body_pos_w[:, :, 2] = 0.03
    close(term(env) * dt, [0.01, 0.0])  # A new episode starts a new jump.


def test_a_jump_is_paid_up_to_the_commanded_height():
    env = fake_env(
        commands={"jump": T([[1.0, 0.03], [0.5, 0.05]])}, data_body_pos_w=torch.zeros(2, 1, 3), step_dt=0.01, **TWO
    )
    env.scene.robot.data.body_pos_w[:, :, 2] = 0.06
    term = rewards.jump_clearance(env, "jump", rest=0.02, target=None, asset_cfg=entity(bodies=[0]))
    close(term(env) * 0.01, [0.03, 0.04])


def test_a_landing_is_paid_once_at_the_end_of_the_window_of_a_flight():
    """Four robots: a soft landing, one with an impact and a tilt, no flight, and a wheel that is still in the air."""
    command, force, velocity, gravity = torch.zeros(4, 1), torch.ones(4, 2), torch.zeros(4, 3), torch.zeros(4, 3)
    four = {"num_envs": 4, "device": torch.device("cpu")}
    env = fake_env(commands={"jump": command}, contact_norm=force, data_root_lin_vel_w=velocity, step_dt=0.01, **four)
    env.scene.robot.data.projected_gravity_b = gravity
    term = rewards.jump_landing(env, "jump", entity("contact", bodies=[0, 1]), 0.5, impact_std=0.5, tilt_std=0.2)
    paid = []

    def step(share, fall, flies):
        command[:], velocity[1, 2] = share, fall
        force[[0, 1, 3]] = 0.0 if flies else 1.0
        paid.append((term(env) * 0.01).tolist())

    step(0.0, 0.0, True)  # before the window
    step(0.0, 9.0, False)  # an impact before the window
    step(1.0, 9.0, False)
    step(0.7, 9.0, True)
    step(0.3, 9.4, False)  # an impact of 0.4 m/s
    force[3, 1], gravity[1, 0] = 0.0, 0.1
    command[:] = 0.0
    paid.append((term(env) * 0.01).tolist())
    assert paid[-1] == pytest.approx([1.0, math.exp(-((0.4 / 0.5) ** 2) - (0.1 / 0.2) ** 2), 0.0, 0.0], abs=1e-5)
    step(0.0, 9.4, False)
    assert not any(any(values) for values in paid[:-2] + paid[-1:])


def test_a_weight_is_added_while_a_jump_is_commanded(start_env):
    name = "wheelleg_exp.mdp.rewards."
    jump = {"_target_": "wheelleg_exp.mdp.commands.JumpCommand", "resampling_time_range": [9.0, 9.0], "window_s": 0.5}
    added = {"_target_": name + "while_commanded", "term": "alive", "command_name": "jump", "weight": -0.75}
    terms = {"alive": {"_target_": name + "is_alive", "weight": 1.0}, "alive_in_jump": added}
    env = start_env(commands={"jump": jump}, rewards=terms, num_envs=2)
    term = env.command_manager.get_term("jump")
    term.start(torch.tensor([True, False]))
    env.step(torch.zeros(2, env.action_manager.total_action_dim))
    assert env.reward_manager.step_reward.sum(dim=0).tolist() == [0.25, 1.0]
    with pytest.raises(ConfigError, match="'alive_in_jump' has state"):
        rewards.while_commanded(env, "alive_in_jump", "jump")


def test_the_apex_of_a_jump_is_known_at_the_take_off():
    env = fake_env(
        commands={"jump": T([[1.0], [1.0]])},
        data_root_pos_w=T([[0.0, 0.0, 0.1], [0.0, 0.0, 0.1]]),
        data_root_lin_vel_w=T([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]),
        step_dt=0.01,
        **TWO,
    )
    env.scene.model = SimpleNamespace(opt=SimpleNamespace(gravity=(0.0, 0.0, -9.81)))
    term = rewards.jump_apex(env, "jump", rest=0.07, target=1.0)
    close(term(env) * 0.01, [0.03 + 1 / (2 * 9.81), 0.03])
