import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from sim.small_envs import env_config, env_of, init_state, variant
from wheelleg_exp.errors import AssetError, ConfigError
from wheelleg_exp.sim.scene import model_digest
from wheelleg_exp.sim.terrain import grid_origins

NAMES = ["left_hip", "right_hip", "left_axle", "right_axle"]
DRIVEN_TWICE = env_config()["robot"]["actuators"]
DRIVEN_TWICE["axles"]["joint_names_expr"] = [".*"]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9, 12, 17, 64, 100])
def test_origins_are_isaac_labs_grid(count):
    rows = math.ceil(count / int(math.sqrt(count)))
    cols = math.ceil(count / rows)
    expected = [(-(k // cols - (rows - 1) / 2) * 2.5, (k % cols - (cols - 1) / 2) * 2.5, 0.0) for k in range(count)]
    assert grid_origins(count, 2.5).tolist() == [list(origin) for origin in expected]


def test_joints_and_bodies_are_ordered_breadth_first_whatever_the_engines_order(make_env):
    scene = make_env().scene
    assert [scene.model.joint(j).name for j in range(1, 5)] == ["left_hip", "left_axle", "right_hip", "right_axle"]
    assert scene.robot.joint_names == NAMES
    assert scene.robot.body_names == ["base", "left_arm", "right_arm", "left_wheel", "right_wheel"]
    robot = scene.robot
    pos, vel = torch.tensor([[0.1, 0.2, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]]).split(1)
    robot.write_joint_state_to_sim(pos, vel, env_ids=torch.tensor([0]))
    assert robot.data.joint_pos[0].tolist() == pytest.approx([0.1, 0.2, 3.0, 4.0])
    assert robot.data.joint_vel[0].tolist() == [1, 2, 3, 4]
    assert robot._qpos[0, 7:].tolist() == pytest.approx([0.1, 3.0, 0.2, 4.0])  # MuJoCo orders joints depth first.


def test_a_user_defined_order_is_used(make_env):
    order = ["right_axle", "left_hip", "left_axle", "right_hip"]
    robot = make_env(robot={"joint_order": order}).scene.robot
    assert robot.joint_names == order
    assert robot.data.default_joint_pos[0].tolist() == pytest.approx([0.0, 0.2, 0.0, 0.2])


@pytest.mark.parametrize(
    ("section", "change", "message"),
    [
        ("robot", {"joint_order": NAMES[:3]}, "lacks right_axle"),
        ("robot", {"joint_order": [*NAMES[:3], "rigth_axle"]}, "did you mean 'right_axle'"),
        ("robot", {"joint_order": [NAMES[0], *NAMES]}, "names left_hip more than once"),
        ("robot", {"init_state": init_state(0.3, {"left_hip": 1.6})}, r"left_hip.*outside its limits"),
        ("robot", {"actuators": DRIVEN_TWICE}, "driven by both"),
        *((section, {"colour": 1}, "colour") for section in ("sim", "scene", "robot")),
    ],
)
def test_wrong_settings_are_rejected(make_env, section, change, message):
    with pytest.raises(ConfigError, match=message):
        make_env(**{section: change})


@pytest.mark.parametrize(
    ("factor", "soft"),
    # The middle of the soft limits is 0.25, and half of their width is 1.25 * 0.8 = 1.
    [(1.0, [-1.0, 1.5]), (0.8, [-0.75, 1.25])],
)
def test_soft_limits_shrink_about_the_middle_and_unlimited_joints_have_infinite_limits(make_env, factor, soft):
    data = make_env(robot={"soft_joint_pos_limit_factor": factor}).scene.robot.data
    unlimited = 2 * [[-math.inf, math.inf]]
    assert data.joint_pos_limits.tolist() == 4 * [[[-1, 1.5], [-1, 1.5], *unlimited]]
    assert data.soft_joint_pos_limits.tolist() == 4 * [[*2 * [pytest.approx(soft)], *unlimited]]


@pytest.mark.parametrize("value", [-0.3, 0.7])
def test_a_default_position_at_the_limit_is_accepted(tmp_path, value):
    config = env_config(robot={"init_state": init_state(0.3, {".*_hip": value})})
    env = env_of(variant(tmp_path, 'range="-1 1.5"', 'range="-.3 .7"'), config)
    assert float(env.scene.robot.data.default_joint_pos[0, 0]) == pytest.approx(value)


def test_a_file_in_degrees_gives_radians_for_hinges_and_metres_for_sliders(make_env):
    limits = make_env("arm").scene.robot.data.joint_pos_limits
    assert limits[0, 0].tolist() == pytest.approx([-math.pi / 2, math.pi / 4])
    assert limits[0, 1].tolist() == pytest.approx([-0.1, 0.2])


@pytest.mark.parametrize(
    ("event", "ranges"),
    [
        ("reset_root_state_uniform", {"pose_range": {"x": [1, 1]}, "velocity_range": {}}),
        ("push_by_adding_velocity", {"velocity_range": {"x": [1, 1]}}),
        ("reset_scene_to_default", {}),
    ],
)
def test_root_events_on_a_fixed_base_do_not_write_into_joints(start_env, event, ranges):
    term = {"_target_": f"wheelleg_exp.mdp.events.{event}", "mode": "reset", **ranges}
    try:
        env = start_env("arm", events={"root": term})
    except ConfigError:
        return
    assert event == "reset_scene_to_default"  # A robot with a fixed base has joints to reset.
    assert env.scene.robot.data.joint_pos[0].tolist() == pytest.approx([0.1, 0.15])
    assert env.scene.robot.data.joint_vel.abs().max() == 0


TWO_ROBOTS = 2 * '<body><freejoint/><geom size=".1"/></body>' + "</worldbody></mujoco>"


@pytest.mark.parametrize(("content", "message"), [(TWO_ROBOTS, "2 robots"), ("", "cannot read")])
def test_a_file_without_exactly_one_robot_is_an_error(tmp_path, content, message):
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody>" + content)
    with pytest.raises(AssetError, match=message):
        env_of(tmp_path / "bad.xml")


def test_whole_numbers_are_numbers(make_env):
    actuators = make_env().cfg["robot"]["actuators"]
    for group in actuators.values():
        group.update({k: round(v) for k, v in group.items() if isinstance(v, float) and v >= 1})
    actuators["hips"].update(stiffness=20, damping=1, effort_limit=4, velocity_limit=30)
    env = make_env(robot={"actuators": actuators})
    assert env.scene.robot.data.soft_joint_vel_limits.tolist() == 4 * [[30, 30, 20, 20]]


def test_a_joint_without_an_actuator_moves_freely(make_env, start_env):
    actuators = make_env().cfg["robot"]["actuators"]
    del actuators["axles"]
    hips = {"_target_": "wheelleg_exp.mdp.actions.JointPositionAction", "joint_names": [".*_hip"]}
    env = start_env(robot={"actuators": actuators}, actions={"a": hips})
    assert env.scene.model.nu == 2
    env.step(torch.zeros(4, 2))
    assert (env.scene.robot.data.applied_torque[:, 2:] == 0).all()
    assert "left_axle" in str(env.scene_manager)


def test_the_log_has_the_share_of_robots_that_end_beyond_a_velocity_limit(start_env):
    env = start_env()
    speed = torch.zeros(4, 4)
    # The speed limits are 20 rad/s (axles) and 30 rad/s (hips).
    speed[0, 2], speed[3, 0], speed[1, 3] = 20.5, -30.5, 19.5
    env.scene.robot.write_joint_velocity_to_sim(speed)
    assert float(env.reset()[1]["log"]["Diagnostics/joint_over_speed"]) == 0.5
    assert float(env.reset()[1]["log"]["Diagnostics/joint_over_speed"]) == 0.0


@pytest.mark.parametrize(("mode", "expected"), [("average", 0.6), ("min", 0.4), ("multiply", 0.32), ("max", 0.8)])
def test_the_coefficients_of_robot_and_ground_are_combined(make_env, mode, expected):
    env = make_env("block", robot={"friction_source": "dynamic", "friction_combine_mode": mode})
    assert float(env.scene.model.geom("cube").friction[0]) == pytest.approx(expected)
    assert env.scene.model.geom("cube").priority[0] > env.scene.model.geom("ground").priority[0]


def test_two_parts_of_the_robot_meet_with_the_greater_of_their_effective_coefficients(tmp_path):
    part = "<body name='{n}'><joint name='{n}' axis='0 1 0'/><geom size='.1' friction='{mu}'/></body>"
    (tmp_path / "two.xml").write_text(
        "<mujoco><worldbody><body name='base'><freejoint/><geom size='.01' mass='1'/>"
        f"{part.format(n='a', mu=0.7)}{part.format(n='b', mu=0.3)}</body></worldbody></mujoco>"
    )
    config = env_config(scene={"sensors": {}}, actions={})
    config["robot"] |= {"actuators": {}, "init_state": init_state(1.0, {}) | {"joint_vel": {}}}
    model = env_of(tmp_path / "two.xml", config).scene.model
    data = _placed(model, 1.0)
    (contact,) = (c for c in data.contact if 0 not in model.geom_bodyid[c.geom])
    assert contact.friction[0] == pytest.approx((0.7 + 0.5) / 2)
    assert sorted(model.geom_friction[contact.geom, 0]) == pytest.approx([0.4, 0.6])


@pytest.mark.parametrize(("wanted", "touch"), [(None, True), (True, True), (False, False)])
def test_the_config_can_disable_the_robots_own_collisions_but_not_those_with_the_ground(make_env, wanted, touch):
    spec = make_env(robot={"self_collisions": wanted}).scene.spec
    spec.geom("left_arm").size[0] = 0.25
    model = spec.compile()
    pairs = {frozenset(model.geom(int(g)).name for g in pair) for pair in _placed(model, 0.02).contact.geom}
    assert (frozenset({"left_arm", "right_arm"}) in pairs) is touch
    assert frozenset({"base_box", "ground"}) in pairs


def test_the_robot_measures_a_turned_gravity(start_env):
    env = start_env(sim={"gravity": [3.0, 0.0, -4.0]})
    torch.testing.assert_close(env.scene.robot.data.projected_gravity_b, torch.tensor([[0.6, 0.0, -0.8]]).expand(4, 3))


def test_two_builds_have_the_same_digest_and_another_timestep_has_not(make_env):
    first, second, other = make_env(), make_env(), make_env(sim={"dt": 0.005})
    assert first.scene.model_digest() == second.scene.model_digest()
    assert first.scene.model_digest() != other.scene.model_digest()


def test_the_group_that_rays_ask_for_the_ground_holds_nothing_else(make_env):
    model = make_env().scene.model
    assert {model.geom(g).name for g in range(model.ngeom) if model.geom_group[g] == 0} == {"ground"}
    assert set(model.geom_group) == {0, 1}  # MuJoCo's viewer shows geom groups 0 and 1.
    down = mujoco.mj_ray(model, _placed(model), [0, 0, 1.0], [0, 0, -1.0], np.eye(1, 6, dtype=np.uint8)[0], 1, -1, None)
    assert down == pytest.approx(1.0)  # The ray passes through the robot.


def _placed(model, height=None):
    data = mujoco.MjData(model)
    data.qpos[2] = data.qpos[2] if height is None else height
    mujoco.mj_forward(model, data)
    return data


MESH = """<mujoco><asset><mesh name="t" file="t.obj"/></asset>
<worldbody><body><freejoint/><geom type="mesh" mesh="t" mass="{mass}"/></body></worldbody></mujoco>"""


def _digest_in(folder: Path, mass: float = 1.0) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (folder / "m.xml").write_text(MESH.format(mass=mass))
    return model_digest(mujoco.MjModel.from_xml_path(str(folder / "m.xml")))


def test_the_digest_does_not_depend_on_the_folder_of_the_meshes(tmp_path):
    assert _digest_in(tmp_path / "here") == _digest_in(tmp_path / "somewhere_else")
    assert _digest_in(tmp_path / "here") != _digest_in(tmp_path / "here", mass=1.0000001)


def test_a_fixed_base_has_the_configured_pose(make_env):
    init = make_env("arm").cfg["robot"]["init_state"]
    env = make_env("arm", robot={"init_state": init | {"pos": [0.3, -0.2, 0.7], "rot": [0.0, 0.0, 0.0, 1.0]}})
    data = env.scene.robot.data
    assert data.root_pos_w[0].tolist() == pytest.approx([0.3, -0.2, 0.7])
    assert data.root_quat_w[0].abs().tolist() == pytest.approx([0.0, 0.0, 0.0, 1.0])
    assert (data.root_lin_vel_w.abs().max(), data.projected_gravity_b[0].tolist()) == (0, pytest.approx([0, 0, -1]))
