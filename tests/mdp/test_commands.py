import math

import mujoco
import numpy as np
import pytest
import torch
from sim.small_envs import ASSETS, env_config, env_of, run, variant

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.export.bundle import runner
from wheelleg_exp.jobs.export.bundle_specification import bump_spec
from wheelleg_exp.mdp.commands import UniformVelocityTravelCommand
from wheelleg_exp.sim.terrain import Plane

pytestmark = pytest.mark.usefixtures("allow_test_terms")
C = "wheelleg_exp.mdp.commands."
STILL = torch.zeros(4, 4)
TIME = [0.1, 0.1]
FRICTION = {"static_friction": 0.5, "dynamic_friction": 0.4, "restitution": 0.0}


class Patches(Plane):
    """A plane that claims to have 2 rows of 3 tiles, each with 3 flat patches."""

    def place(self, num_envs, spacing, device, stream):
        super().place(num_envs, spacing, device, stream)
        self.terrain_levels = torch.arange(num_envs) % 2
        self.terrain_types = torch.arange(num_envs) % 3
        rows, cols, number = torch.meshgrid(torch.arange(2), torch.arange(3), torch.arange(3), indexing="ij")
        self.flat_patches["target"] = torch.stack((rows, cols, 10 * number), dim=-1).float()


class Ledge(Plane):
    """A plane that claims to be 30 mm higher where x is larger than 0.1 m."""

    def height_at(self, xy):
        return torch.where(xy[..., 0] > 0.1, 0.03, 0.0)


def _env(start_env, kind, /, **fields):
    sections = {name: fields.pop(name) for name in ("seed", "num_envs", "scene") if name in fields}
    env = start_env(commands={"c": {"_target_": C + kind, **fields}}, **sections)
    return env, env.command_manager.get_term("c")


def _stand(env, position, yaw=0.0, pitch=0.0, roll=0.0):
    """Place every robot at a position with the orientation Rz(yaw) Ry(pitch) Rx(roll), computed by MuJoCo."""
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.array([yaw, pitch, roll]), "zyx")
    pose = torch.tensor([*position, *quat], dtype=torch.float32).expand(env.num_envs, 7)
    env.scene.robot.write_root_pose_to_sim(pose, torch.arange(env.num_envs))
    env.scene.refresh()


NORMAL = {"mean_vel": [0.5, 0.0, 1.0], "std_vel": [0.1, 0.2, 0.0], "zero_prob": [0.0, 0.0, 0.3]}


def test_normal_velocities_have_both_signs_their_moments_and_zeros(start_env):
    env, term = _env(start_env, "NormalVelocityCommand", num_envs=4000, resampling_time_range=TIME, ranges=NORMAL)
    env.command_manager.compute(0.0)
    v_x, v_y, w_z = term.command.unbind(dim=1)
    for values, mean, std in ((v_x.abs(), 0.5, 0.1), (v_y, 0.0, 0.2)):
        assert float(values.mean()) == pytest.approx(mean, abs=0.02)
        assert float(values.std()) == pytest.approx(std, abs=0.01)
    assert float((v_x > 0).float().mean()) == pytest.approx(0.5, abs=0.04)
    shares = [float((w_z == value).float().mean()) for value in (-1.0, 0.0, 1.0)]
    assert shares == pytest.approx([0.35, 0.3, 0.35], abs=0.04)
    assert abs(float(torch.corrcoef(torch.stack((v_x, w_z)))[0, 1])) < 0.06


def test_normal_velocities_stand_and_are_zero_only_from_the_first_compute_on(start_env):
    ranges = NORMAL | {"zero_prob": [1.0, 0.0, 0.0]}
    env, term = _env(start_env, "NormalVelocityCommand", resampling_time_range=[9.0, 9.0], ranges=ranges)
    assert (term.command != 0).all()
    for _ in range(2):
        env.step(STILL)
        assert (term.command != 0).tolist() == [[False, True, True]] * 4
    standing = {"ranges": NORMAL, "rel_standing_envs": 1.0}
    env, term = _env(start_env, "NormalVelocityCommand", resampling_time_range=TIME, **standing)
    env.step(STILL)
    assert (term.command == 0).all()


AXLES = ["left_axle", "right_axle"]
WHEELS = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", "joint_names": AXLES}
SEEN = {"_target_": "wheelleg_exp.mdp.observations.travel_error", "command_name": "c"}


def _travel_node(v_x=0.3, w_z=0.5, most=(10.0, 10.0), wheel_radius=0.1, **fields):
    node = {"ranges": {"lin_vel_x": [v_x, v_x], "ang_vel_z": [w_z, w_z]}, "resampling_time_range": [9.0, 9.0]}
    node |= {"wheel_cfg": WHEELS, "wheel_radius": wheel_radius}
    return node | {"max_travel_error": most[0], "max_heading_error": most[1]} | fields


def _travel(start_env, **fields):
    return _env(start_env, "UniformVelocityTravelCommand", **_travel_node(**fields))


def test_travel_is_what_wheels_and_gyroscope_add_up_to_beyond_the_command(start_env):
    env, term = _travel(start_env)
    _stand(env, [0.0, 0.0, 0.5], pitch=0.6, roll=-0.7)
    data, expected = env.scene.robot.data, torch.zeros(4, 2)
    columns = [env.scene.robot.joint_names.index(name) for name in AXLES]
    push = torch.tensor([[0.0, 0.0, 1.0, -2.0], [0.0, 0.0, 3.0, 3.0], [0.0] * 4, [0.5, 0.1, -1.0, 1.0]])
    for _ in range(20):
        env.step(push)
        rolled = 0.1 * data.joint_vel[:, columns].mean(dim=1)
        turned = data.root_ang_vel_b[:, 2]
        expected += torch.stack((rolled - 0.3, turned - 0.5), dim=1) * env.step_dt
    torch.testing.assert_close(term.travel_error, expected)
    assert (expected.std(dim=0) > 1e-3).all()


def _rover(tmp_path, axis):
    name = '<joint name="right_axle" axis='
    return variant(tmp_path, f'{name}"0 1 0"/>', f'{name}"{axis}"/>')


def _travel_of(path):
    node = {"_target_": C + "UniformVelocityTravelCommand", **_travel_node(w_z=0.0, wheel_radius=0.04)}
    env = env_of(path, env_config("rover", commands={"c": node}, num_envs=2))
    env.reset()
    return env, env.command_manager.get_term("c")


@pytest.mark.parametrize(("axis", "sign"), [("0 1 0", 1.0), ("0 -1 0", -1.0), ("0 -.8 .6", -1.0)])
def test_travel_of_wheels_whose_axes_are_mirrored_is_forwards_for_both(tmp_path, axis, sign):
    """The lowest point of a wheel's rim moves backwards if the wheel rolls forwards, for both signs of the axis."""
    env, term = _travel_of(_rover(tmp_path, axis))
    assert term.wheel_signs == (1.0, sign)
    model, data = env.scene.sim.model, mujoco.MjData(env.scene.sim.model)
    data.qvel[[model.joint(name).dofadr[0] for name in AXLES]] = [2.0, 2.0 * sign]
    mujoco.mj_forward(model, data)
    turning = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body("right_wheel").id, turning, 0)
    assert np.cross(turning[:3], [0.0, 0.0, -0.04])[0] < 0.0
    columns = [env.scene.robot.joint_names.index(name) for name in AXLES]
    expected = torch.zeros(2)
    for push in ([0.0, 0.0, 1.0, -2.0], [0.0, 0.0, 3.0, 3.0]):
        env.step(torch.tensor([push, push]))
        left, right = env.scene.robot.data.joint_vel[:, columns].unbind(dim=1)
        expected += (0.04 * (left + sign * right) / 2 - 0.3) * env.step_dt
    torch.testing.assert_close(term.travel_error[:, 0], expected)


def test_a_wheel_that_rolls_sideways_is_named(tmp_path):
    with pytest.raises(ConfigError, match="joint 'right_axle' does not roll the robot forwards") as caught:
        _travel_of(_rover(tmp_path, "1 0 0"))
    assert caught.value.key == "env.commands.c.wheel_cfg.joint_names"


def test_travel_is_summed_up_to_a_bound_and_from_zero_in_each_episode(start_env):
    env, term = _travel(start_env, v_x=50.0, w_z=-50.0, most=(0.4, 0.2))
    run(env, 3)
    assert term.travel_error.tolist() == [pytest.approx([-0.4, 0.2])] * 4
    env.reset(env_ids=torch.tensor([1, 3]))
    assert term.travel_error.tolist() == [pytest.approx([-0.4, 0.2]), [0.0, 0.0]] * 2


def test_a_command_approaches_its_target_with_no_more_than_its_acceleration(start_env):
    """The expected command starts at 0 and changes by at most 2 m/s² and 3 rad/s² times the control step."""
    env, term = _travel(start_env, w_z=-0.5, max_lin_acceleration=2.0, max_ang_acceleration=3.0)
    lin, ang = 2.0 * env.step_dt, 3.0 * env.step_dt
    assert 5 * lin < 0.3 < 40 * lin
    for step in range(2, 40):
        env.step(STILL)
        assert term.command[0].tolist() == pytest.approx([min(0.3, step * lin), 0.0, -min(0.5, step * ang)], rel=1e-5)
    assert term.asked.tolist() == [pytest.approx([0.3, 0.0, -0.5])] * 4
    env.reset(env_ids=torch.tensor([2]))
    assert term.command[2].tolist() == pytest.approx([lin, 0.0, -ang])
    assert term.command[1].tolist() == pytest.approx([0.3, 0.0, -0.5])


def test_a_command_without_an_acceleration_jumps(start_env):
    env, term = _travel(start_env)
    assert term.max_acceleration == (None, None, None)
    assert term.command.tolist() == [pytest.approx([0.3, 0.0, 0.5])] * 4
    env.step(STILL)
    torch.testing.assert_close(term.asked, term.command)


def test_travel_is_observed_and_rewarded(start_env):
    cost = {"_target_": "wheelleg_exp.mdp.rewards.travel_error_l2", "command_name": "c", "heading_length": 0.5}
    command = {"_target_": C + "UniformVelocityTravelCommand", **_travel_node(most=(0.4, 0.2))}
    sections = {"commands": {"c": command}, "observations": {"policy": {"terms": {"t": SEEN}}}}
    env = start_env(**sections, rewards={"t": {**cost, "weight": -1.0}})
    term = env.command_manager.get_term("c")
    term.travel_error.copy_(torch.tensor([[0.1, 0.2], [-0.3, 0.0], [0.0, -0.1], [0.4, 0.1]]))
    expected = torch.tensor([0.01 + 0.01, 0.09, 0.0025, 0.16 + 0.0025])
    _, reward, *_ = env.step(STILL)
    torch.testing.assert_close(reward, -expected * env.step_dt)
    torch.testing.assert_close(env.observation_manager.compute()["policy"][:, -2:], term.travel_error)


def test_a_command_that_does_not_integrate_its_error_is_rejected(make_env):
    plain = {"_target_": C + "UniformVelocityCommand", "resampling_time_range": [9.0, 9.0], "ranges": {}}
    with pytest.raises(ConfigError, match="does not integrate its error"):
        make_env(commands={"c": plain}, observations={"policy": {"terms": {"t": SEEN}}})


def test_a_null_command_draws_logs_and_commands_nothing(start_env):
    env, term = _env(start_env, "NullCommand")
    stream = env.streams.get("env.commands.c").get_state()
    env.step(STILL)
    env.reset()
    assert term.command.shape == (4, 0)
    assert not [name for name in env.extras["log"] if "Metrics" in name]
    assert torch.equal(env.streams.get("env.commands.c").get_state(), stream)
    assert "NullCommand" in env.describe()


PLACE = {"pos_x": [1.0, 1.0], "pos_y": [2.0, 2.0], "heading": [math.pi / 2, math.pi / 2]}


def _place(start_env, **fields):
    node = {"resampling_time_range": [9.0, 9.0], "simple_heading": False, "ranges": PLACE}
    return _env(start_env, "UniformPose2dCommand", **node | fields)


def test_places_lie_around_the_origin_of_their_environment(start_env):
    ranges = {"pos_x": [-0.5, 1.0], "pos_y": [0.0, 2.0], "heading": [-1.0, 3.0]}
    env, term = _place(start_env, ranges=ranges, num_envs=2000)
    drawn = torch.cat((term.pos_command_w - env.scene.env_origins, term.heading_command_w.unsqueeze(1)), dim=1)
    for column, (low, high) in ((0, (-0.5, 1.0)), (1, (0.0, 2.0)), (3, (-1.0, 3.0))):
        assert low <= float(drawn[:, column].min()) < low + 0.03
        assert high - 0.03 < float(drawn[:, column].max()) <= high + 1e-5
    assert drawn[:, 2].tolist() == pytest.approx([0.3] * 2000)  # the height of the robot's default state


def test_the_command_is_the_way_in_the_axes_of_the_bases_yaw(start_env):
    """The way from (.5, -1, .1) to (1, 2, .3) is turned back by the yaw of 30 degrees, for any pitch."""
    env, term = _place(start_env, num_envs=1)
    assert (term.command == 0).all()  # until the first compute
    yaw = math.radians(30)
    cos, sin = math.cos(yaw), math.sin(yaw)
    for pitch in (0.0, 0.5):
        _stand(env, [0.5, -1.0, 0.1], yaw=yaw, pitch=pitch)
        env.command_manager.compute(0.02)
        expected = [0.5 * cos + 3 * sin, 3 * cos - 0.5 * sin, 0.2, math.radians(60)]
        assert term.command[0].tolist() == pytest.approx(expected, abs=1e-6)
    assert torch.equal(term.pos_command_b, term.command[:, :3])
    assert torch.equal(term.heading_command_b, term.command[:, 3])


@pytest.mark.parametrize(("yaw", "expected"), [(0.5, math.atan2(3, 2)), (-2.5, math.atan2(3, 2) - math.pi)])
def test_a_simple_heading_is_along_the_way_forwards_or_backwards(start_env, yaw, expected):
    env, term = _place(start_env, simple_heading=True, ranges={"pos_x": [1.0, 1.0], "pos_y": [2.0, 2.0]}, num_envs=1)
    _stand(env, [-1.0, -1.0, 0.3], yaw=yaw)
    term.draw(torch.arange(1))
    assert term.heading_command_w.tolist() == pytest.approx([expected], abs=1e-5)


def test_the_metrics_of_a_place_are_the_last_errors(start_env):
    env, _ = _place(start_env, num_envs=1)
    for x, yaw in ((0.0, 0.0), (0.5, -3.0)):
        _stand(env, [x, 2.0, 7.0], yaw=yaw)
        env.command_manager.compute(0.02)
    log = env.command_manager.reset(torch.arange(1))
    assert float(log["Metrics/c/error_pos_2d"]) == pytest.approx(0.5, abs=1e-6)
    assert float(log["Metrics/c/error_heading"]) == pytest.approx(2 * math.pi - 3 - math.pi / 2, abs=1e-5)
    assert float(log["Episode_Metrics/c/error_pos_2d_per_step"]) == pytest.approx(0.75, abs=1e-6)


def test_a_place_can_be_a_flat_patch_of_the_tile(start_env):
    node = {"resampling_time_range": [9.0, 9.0], "simple_heading": True, "ranges": {}}
    scene = {"terrain": {"_target_": "mdp.test_commands.Patches"} | FRICTION}
    env, term = _env(start_env, "TerrainBasedPose2dCommand", num_envs=600, scene=scene, **node)
    terrain, place = env.scene.terrain, term.pos_command_w
    assert torch.equal(place[:, 0].long(), terrain.terrain_levels)
    assert torch.equal(place[:, 1].long(), terrain.terrain_types)
    # A patch is at (row, column, 10 * number), and the robot's default height of .3 m is added.
    counts = [int((place[:, 2] - 0.3 - height).abs().lt(1e-5).sum()) for height in (0.0, 10.0, 20.0)]
    assert sum(counts) == 600
    assert all(150 < count < 250 for count in counts)


POSE = {"pos_x": [0.1, 0.1], "pos_y": [0.2, 0.2], "pos_z": [-0.1, -0.1], "roll": [0.3, 0.3], "yaw": [3.0, 3.0]}


def _body(start_env, **fields):
    node = {"body_name": "left_wheel", "resampling_time_range": [9.0, 9.0], "ranges": POSE}
    return _env(start_env, "UniformPoseCommand", **node | fields)


def test_a_pose_is_drawn_in_the_frame_of_the_root(start_env):
    _, term = _body(start_env)
    cos, sin = [math.cos(1.5), math.cos(0.15)], [math.sin(1.5), math.sin(0.15)]
    quat = [cos[0] * cos[1], cos[0] * sin[1], sin[0] * sin[1], sin[0] * cos[1]]  # qz(3) * qx(.3)
    assert term.command[0].tolist() == pytest.approx([0.1, 0.2, -0.1, *quat], abs=1e-6)
    ranges = POSE | {"yaw": [4.0, 4.0]}  # cos(2) < 0
    for unique, sign in ((False, -1.0), (True, 1.0)):
        assert float(_body(start_env, ranges=ranges, make_quat_unique=unique)[1].command[0, 3]) * sign > 0


@pytest.mark.parametrize("pitch", [0.25, 0.25 + 2 * math.pi])  # after one more turn, the quaternion has the other sign
def test_the_metrics_of_a_pose_are_distance_and_angle_to_the_body(start_env, pitch):
    """The left wheel is at (0, .13, -.08) m in the base's frame if the hip is straight."""
    ranges = {"pos_x": [0.3, 0.3], "pos_y": [0.13, 0.13], "pos_z": [0.32, 0.32], "pitch": [pitch, pitch]}
    env, term = _body(start_env, ranges=ranges, num_envs=1)
    env.scene.robot.write_joint_state_to_sim(torch.zeros(1, 4), torch.zeros(1, 4), env_ids=torch.arange(1))
    _stand(env, [1.0, -2.0, 0.5], yaw=1.0, pitch=-0.4, roll=0.2)
    # The distance is the hypotenuse of .3 and .4.
    assert term.errors()[:, 0].tolist() == pytest.approx([0.5, 0.25], abs=1e-5)


BASE = {"height": [0.2, 0.4], "pitch": [-0.2, 0.1]}


def _base(start_env, **fields):
    return _env(start_env, "UniformBasePoseCommand", **{"resampling_time_range": TIME, "ranges": BASE} | fields)


def test_heights_and_tilts_are_uniform_in_their_ranges(start_env):
    _, term = _base(start_env, num_envs=3000)
    assert (term.command[:, 1] == 0).all()
    for column, (low, high) in ((0, BASE["height"]), (2, BASE["pitch"])):
        values = term.command[:, column]
        assert low <= float(values.min()) < low + 0.01
        assert high - 0.01 < float(values.max()) <= high
        assert float(values.mean()) == pytest.approx((low + high) / 2, abs=0.02)


def test_height_is_above_the_ground_and_tilts_are_roll_and_pitch(start_env):
    ground = {"terrain": {"_target_": "managers.spies.Step", "height": 0.5} | FRICTION}
    env, term = _base(start_env, num_envs=1, scene=ground)
    _stand(env, [5.0, 0.2, 0.9], yaw=2.0, pitch=0.3, roll=-0.4)  # on the step
    assert term.measured()[0].tolist() == pytest.approx([0.4, -0.4, 0.3], abs=1e-5)
    _stand(env, [2.0, 0.2, 0.9], pitch=-1.2, roll=3.0)
    assert term.measured()[0].tolist() == pytest.approx([0.9, 3.0, -1.2], abs=1e-5)


def test_the_metrics_of_the_base_are_means_over_the_time_between_draws(start_env):
    ranges = {name: [value, value] for name, value in (("height", 0.3), ("roll", 0.1), ("pitch", -0.1))}
    env, _ = _base(start_env, num_envs=1, ranges=ranges)
    _stand(env, [0.0, 0.0, 0.25], pitch=0.1)
    for _ in range(2):
        env.command_manager.compute(0.02)
    log = env.command_manager.reset(torch.arange(1))
    for axis, error in (("height", 0.05), ("roll", 0.1), ("pitch", 0.2)):
        assert float(log[f"Metrics/c/error_{axis}"]) == pytest.approx(error * 2 * 0.02 / 0.1, abs=1e-5)
        assert float(log[f"Episode_Metrics/c/error_{axis}_per_step"]) == pytest.approx(error, abs=1e-5)


def _measured(path=None, most=10.0, height=0.2):
    """An environment of two rovers whose command measures their height over the wheels, with a radius of 40 mm."""
    node = {"_target_": C + "WheeledBasePoseCommand", "ranges": {"height": [height, height]}, "wheel_cfg": WHEELS}
    node |= {"resampling_time_range": [9.0, 9.0], "wheel_radius": 0.04, "max_height_error": most}
    seen = {"_target_": "wheelleg_exp.mdp.observations.height_error", "command_name": "c"}
    fields = {"commands": {"c": node}, "observations": {"policy": {"terms": {"seen": seen}}}}
    env = env_of(path or ASSETS / "rover.xml", env_config("rover", num_envs=2, **fields))
    env.reset()
    return env, env.command_manager.get_term("c")


@pytest.mark.parametrize("hip", ['type="slide" axis="0 .6 .8"', 'pos=".01 .02 .03" axis="0 .6 .8"'])
def test_the_height_over_the_wheels_is_that_of_mujocos_kinematics(tmp_path, hip):
    """The left leg has a second joint, and encoders with a bias measure another pose than the true one."""
    knee = '<joint name="knee" pos=".01 0 .02" axis=".6 .8 0"/>'
    path = variant(tmp_path, '<joint name="left_axle"', f'{knee}<joint name="left_axle"')
    path.write_text(path.read_text().replace('<joint name="left_hip" axis="0 1 0"', f'<joint name="left_hip" {hip}'))
    env, term = _measured(path)
    robot, model = env.scene.robot, env.scene.sim.model
    _stand(env, [0.0, 0.0, 0.5], yaw=1.0, pitch=0.4, roll=-0.3)
    positions = torch.tensor([[0.7, -0.4, 0.5, 5.0, 1.0], [-0.5, 0.9, -0.6, 0.0, 2.0]])
    robot.write_joint_state_to_sim(positions, torch.zeros(2, 5))
    robot.data.encoder_bias.copy_(torch.tensor([[0.1, -0.2, 0.0, 0.3, 0.0], [0.0, 0.1, -0.3, 0.0, 1.0]]))
    robot.data.has_encoder_bias = True
    env.scene.refresh()
    heights, data = [], mujoco.MjData(model)
    for row in range(2):
        data.qpos[:7] = env.scene.sim.view("qpos")[row, :7]
        for name, value in zip(robot.joint_names, robot.data.joint_pos_measured[row].tolist(), strict=True):
            data.qpos[model.joint(name).qposadr[0]] = value
        mujoco.mj_kinematics(model, data)
        axles = [data.xanchor[model.joint(name).id][2] for name in AXLES]
        heights.append(data.xpos[model.body("base").id][2] - np.mean(axles) + 0.04)
    torch.testing.assert_close(term.height_over_wheels(), torch.tensor(heights), atol=1e-6, rtol=0.0, check_dtype=False)
    assert abs(heights[0] - heights[1]) > 0.001
    torch.testing.assert_close(term.height_error(), torch.tensor(heights).float() - 0.2)


def test_the_height_error_is_summed_up_to_a_bound_and_from_zero_in_each_episode():
    env, term = _measured(most=0.005, height=0.3)
    expected = torch.zeros(2)
    for _ in range(3):
        env.step(torch.zeros(2, 4))
        expected = (expected + term.height_error() * env.step_dt).clamp(-0.005, 0.005)
        seen = env.observation_manager.compute()["policy"][:, -2:]
        torch.testing.assert_close(seen, torch.stack((term.height_error(), expected), dim=1))
    assert (expected == -0.005).all()
    env.reset(env_ids=torch.tensor([1]))
    assert term.integrated_error.tolist() == pytest.approx([-0.005, 0.0])


def test_a_jump_is_commanded_in_the_last_part_of_the_time_between_two_draws(start_env):
    fields = {"resampling_time_range": [1.0, 1.0], "window_s": 0.25}
    env, term = _env(start_env, "JumpCommand", num_envs=2, **fields)
    seen = []
    for _ in range(20):
        env.command_manager.compute(0.1)
        seen.append(round(float(term.command[0, 0]), 3))
    assert seen == ([0.0] * 7 + [0.8, 0.4, 0.0]) * 2
    _, term = _env(start_env, "JumpCommand", num_envs=2000, rel_jumping_envs=0.3, **fields)
    assert float(term.is_jumping_env.float().mean()) == pytest.approx(0.3, abs=0.04)
    with pytest.raises(ConfigError, match=r"window_s.*less than 1 s"):
        _env(start_env, "JumpCommand", num_envs=2, resampling_time_range=[1.0, 2.0], window_s=1.0)


def test_a_jump_has_a_drawn_height_in_its_window_and_the_largest_before_a_step(start_env):
    fields = {"resampling_time_range": [1.0, 1.0], "window_s": 0.25}
    env, term = _env(start_env, "JumpCommand", num_envs=2000, heights=[0.02, 0.05], **fields)
    drawn = term.heights.clone()
    assert (float(drawn.min()), float(drawn.max())) == pytest.approx((0.02, 0.05), abs=1e-4)
    assert float(drawn.mean()) == pytest.approx(0.035, abs=0.001)
    seen = [env.command_manager.compute(0.1) or term.command.clone() for _ in range(10)]
    assert [bool(torch.equal(command[:, 1:], drawn)) for command in seen] == [False] * 7 + [True, True, False]
    assert not torch.stack(seen[:7]).any()
    assert not torch.equal(term.heights, drawn)  # The next jump has another height.
    term.start(torch.arange(2000) == 0)
    assert term.command[:2].tolist() == [pytest.approx([1.0, 0.05]), [0.0, 0.0]]


def test_a_jump_is_commanded_where_the_ground_ahead_is_higher(start_env):
    drive = {"_target_": C + "UniformVelocityCommand", "ranges": {"lin_vel_x": [0.3, 0.3]}}
    times = {"resampling_time_range": [9.0, 9.0], "window_s": 0.3, "ahead_s": 0.5}
    jump = {"_target_": C + "JumpCommand", "velocity_command": "drive", "rel_jumping_envs": 0.0, **times}
    commands = {"drive": drive | {"resampling_time_range": [9.0, 9.0]}, "jump": jump | {"rise": 0.02}}
    env = start_env(commands=commands, scene={"terrain": {"_target_": "mdp.test_commands.Ledge", **FRICTION}})
    term = env.command_manager.get_term("jump")

    def commanded(x, yaw):
        """Return the command after one to five times 0.1 s at a place 0.15 m before the point ahead."""
        _stand(env, (x, 0.0, 0.1), yaw)
        return [round(float((env.command_manager.compute(0.1), term.command[0, 0])[1]), 3) for _ in range(5)]

    assert commanded(-0.06, 0.0) == [0.0] * 5
    assert commanded(-0.06, math.pi) == commanded(0.2, math.pi) == [0.0] * 5
    assert commanded(-0.04, 0.0) == [1.0, 0.667, 0.333, 0.0, 1.0]


def _bump_env(start_env, max_lin_acceleration=3.0):
    """Two robots that drive at 0.2 m/s; return the environment, the command to drive, and the command to jump."""
    drive = {"_target_": C + "UniformVelocityTravelCommand", **_travel_node(max_lin_acceleration=max_lin_acceleration)}
    drive |= {"ranges": {"lin_vel_x": [0.2, 0.2]}, "resampling_time_range": [99.0, 99.0]}
    jump = {"_target_": C + "JumpCommand", "velocity_command": "drive", "rel_jumping_envs": 0.0, "trigger": "bump"}
    jump |= {
        "resampling_time_range": [99.0, 99.0],
        "window_s": 0.5,
        "heights": [0.02, 0.05],
        "bump": {"back": 0.4, "run_up": 0.5, "wait_s": 0.3},
    }
    env = start_env(commands={"drive": drive, "jump": jump}, num_envs=2)
    return env, env.command_manager.get_term("drive"), env.command_manager.get_term("jump")


def test_a_bump_sends_the_robot_back_then_to_a_jump_before_the_same_place(start_env, monkeypatch):
    place, rolled = torch.zeros(2), torch.zeros(2)
    monkeypatch.setattr(UniformVelocityTravelCommand, "rolled", property(lambda _: rolled))
    env, travel, term = _bump_env(start_env)
    dt, way, stops, jumped = env.step_dt, [], [], []
    for _ in range(round(6.0 / dt)):
        if way and way[-1] < 0.0:
            travel.asked[1, 0] = 0.0  # The user of the second robot stops it while it drives back.
        env.command_manager.compute(dt)
        command = travel.command[:, 0]
        is_blocked = (place >= 0.5) & (command > 0.0) & (term.command[:, 0] == 0.0) & (place < 0.52)
        stops += [float(place[0])] * bool(is_blocked[0])
        jumped += [float(place[0])] * bool(term.command[0, 0] == 1.0)
        rolled.copy_(torch.where(is_blocked, torch.zeros(2), command))
        place += rolled * dt
        way.append(round(float(command[0]), 3))
    (start,) = jumped
    assert start == pytest.approx(stops[0] - 0.11 * 0.5, abs=0.5 * dt)
    assert (min(way), max(way), way[-1]) == (-0.5, 0.5, 0.2)  # back, run-up, and again as the user wants
    assert float(place[0]) > 0.8
    assert 0.4 < float(place[1]) <= stops[0]
    assert term.bump.phase.tolist() == [0, 0]
    with pytest.raises(ConfigError, match=r"velocity_command.*must drive back"):
        _env(start_env, "JumpCommand", resampling_time_range=[9.0, 9.0], window_s=0.5, trigger="bump")


def test_neither_a_reversal_nor_a_jump_is_a_bump_and_a_reset_forgets_one(start_env, monkeypatch):
    rolled = torch.zeros(2)
    monkeypatch.setattr(UniformVelocityTravelCommand, "rolled", property(lambda _: rolled))
    env, travel, term = _bump_env(start_env)
    phases = set()
    for step in range(round(4.0 / env.step_dt)):
        if step == round(1.0 / env.step_dt):
            travel.asked[:, 0] = -0.5
        if step == round(3.0 / env.step_dt):
            term.start(torch.ones(2, dtype=torch.bool))
        env.command_manager.compute(env.step_dt)
        rolled.lerp_(travel.command[:, 0], 0.1).masked_fill_(term.command[:, 0] > 0.0, 0.0)  # no roll in the air
        phases |= set(term.bump.phase.tolist())
    assert phases == {0}
    for _ in range(round(0.6 / env.step_dt)):
        rolled.fill_(0.0)
        env.command_manager.compute(env.step_dt)
    assert term.bump.phase.tolist() == [1, 1]
    assert (travel.command[:, 0] > -0.5).all()  # forwards, away from what is behind the robot
    env.command_manager.reset(torch.tensor([1]))
    assert term.bump.phase.tolist() == [1, 0]


@pytest.mark.parametrize("max_lin_acceleration", [3.0, None])
def test_the_exported_runner_repeats_the_commands_of_the_simulation(start_env, monkeypatch, max_lin_acceleration):
    """Two robots before a step at 0.5 m; the second user stops during the way back, drives backwards, and returns."""
    radius, place, speeds = np.float32(0.1), torch.tensor([0.0, 0.47]), torch.zeros(2)
    monkeypatch.setattr(UniformVelocityTravelCommand, "rolled", property(lambda _: speeds * float(radius)))
    env, travel, term = _bump_env(start_env, max_lin_acceleration)
    wheels = {"function": "travel_error", "command": "commands.drive", "columns": [0], "signs": [1.0]}
    spec = bump_spec(env, [{"terms": [wheels | {"wheel_radius": float(radius)}]}], ["drive", "jump"])
    found = [runner.Bump(spec, env.step_dt) for _ in range(2)]
    dt, phases, asked, first, jumped = env.step_dt, [set(), set()], [[0.2, 0.0, 0.3]] * 2, True, False
    env.reset()
    travel.asked[:] = torch.tensor(asked)
    travel.command.copy_(travel.asked.clamp(-travel._fastest, travel._fastest))
    for step in range(round(20.0 / dt)):
        for moment, speed in ((0.8, 0.0), (2.0, -0.3), (3.5, 0.2), (9.0, -0.2), (9.5, 0.2)):
            if step == round(moment / dt):
                asked = [asked[0], [speed, 0.0, 0.3]]
        if not first:
            travel.asked[:] = torch.tensor(asked)
            env.command_manager.compute(dt)
        first = False
        if step == round(17.0 / dt):
            term.start(torch.tensor([False, True]))  # The user wants a jump.
            jumped = True
        for i, bump in enumerate(found):
            readings = {
                "joint_vel": speeds[i : i + 1].numpy(),
                "commands.jump": np.array([float(jumped and i), 0.0], "f"),
            }
            sent = bump.commands(readings | {"commands.drive": np.array(asked[i], "f")}, 1)
            np.testing.assert_allclose(sent["commands.drive"], travel.command[i], atol=1e-6, err_msg=str(step))
            np.testing.assert_allclose(sent["commands.jump"], term.command[i], atol=1e-6, err_msg=str(step))
            assert bump.phase == int(term.bump.phase[i])
            phases[i].add(bump.phase)
        jumped = False
        command = travel.command[:, 0]
        blocked = (place >= 0.5) & (command > 0.0) & (term.command[:, 0] == 0.0) & (place < 0.52)
        speeds.copy_(torch.where(blocked, torch.zeros(2), speeds + 0.4 * (command / float(radius) - speeds)))
        place += speeds * radius * dt
    assert phases == [{0, 1, 2, 3}] * 2
    assert float(place.min()) > 0.8
    found[0].on = False
    assert found[0].commands({"commands.drive": np.array([0.1, 0.0, 0.0], "f")}, 1) == {}
    found[0].on, still = True, {"joint_vel": np.zeros(1, "f"), "commands.jump": np.zeros(2, "f")}
    sent = found[0].commands(still | {"commands.drive": np.array([0.1, 0.0, 0.0], "f")}, 1)
    np.testing.assert_allclose(sent["commands.drive"], [0.1, 0.0, 0.0], atol=1e-6)
