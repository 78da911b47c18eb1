"""The scene: origins, names, limits, friction, freshness."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from sim.small_envs import PLANE, env_config
from wheelleg_exp.errors import AssetError, ConfigError
from wheelleg_exp.sim.scene import model_digest
from wheelleg_exp.sim.terrain import grid_origins


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9, 12, 17, 64, 100])
def test_origins_are_isaac_labs_grid(count):
    rows = math.ceil(count / int(math.sqrt(count)))
    cols = math.ceil(count / rows)
    expected = [(-(k // cols - (rows - 1) / 2) * 2.5, (k % cols - (cols - 1) / 2) * 2.5, 0.0) for k in range(count)]
    assert grid_origins(count, 2.5).tolist() == [list(origin) for origin in expected]


def test_four_environments_stand_around_the_worlds_origin():
    assert grid_origins(4, 2.0).tolist() == [[1, -1, 0], [1, 1, 0], [-1, -1, 0], [-1, 1, 0]]


def test_joints_and_bodies_come_breadth_first_whatever_the_engine_says(make_env):
    scene = make_env().scene
    assert [scene.model.joint(j).name for j in range(1, 5)] == ["left_hip", "left_axle", "right_hip", "right_axle"]
    assert scene.robot.joint_names == ["left_hip", "right_hip", "left_axle", "right_axle"]
    assert scene.robot.body_names == ["base", "left_arm", "right_arm", "left_wheel", "right_wheel"]


def test_joint_quantities_follow_the_robots_order(make_env):
    robot = make_env(num_envs=1).scene.robot
    robot.write_joint_state_to_sim(
        torch.tensor([[0.1, 0.2, 3.0, 4.0]]), torch.tensor([[1.0, 2, 3, 4]]), env_ids=torch.tensor([0])
    )
    assert robot.data.joint_pos[0].tolist() == pytest.approx([0.1, 0.2, 3.0, 4.0])
    assert robot.data.joint_vel[0].tolist() == [1, 2, 3, 4]
    assert robot._qpos[0, 7:].tolist() == pytest.approx([0.1, 3.0, 0.2, 4.0])  # the engine's order: depth first


def test_an_order_of_the_users_own_is_kept(make_env):
    order = ["right_axle", "left_hip", "left_axle", "right_hip"]
    robot = make_env(robot={"joint_order": order}).scene.robot
    assert robot.joint_names == order
    assert robot.data.default_joint_pos[0].tolist() == pytest.approx([0.0, 0.2, 0.0, 0.2])


@pytest.mark.parametrize(
    ("order", "message"),
    [
        (["left_hip", "right_hip", "left_axle"], "lacks right_axle"),
        (["left_hip", "right_hip", "left_axle", "rigth_axle"], "did you mean 'right_axle'"),
        (["left_hip", "left_hip", "right_hip", "left_axle", "right_axle"], "names left_hip more than once"),
    ],
)
def test_an_order_that_is_none_is_an_error(make_env, order, message):
    with pytest.raises(ConfigError, match=message):
        make_env(robot={"joint_order": order})


def test_limits_of_unlimited_joints_are_infinite(make_env):
    data = make_env().scene.robot.data
    assert data.joint_pos_limits.tolist() == 4 * [[[-1, 1.5], [-1, 1.5], *2 * [[-math.inf, math.inf]]]]
    assert data.soft_joint_pos_limits.tolist() == data.joint_pos_limits.tolist()


def test_soft_limits_shrink_about_the_middle(make_env):
    data = make_env(robot={"soft_joint_pos_limit_factor": 0.8}).scene.robot.data
    # middle .25, half width 1.25 * .8 = 1
    assert data.soft_joint_pos_limits[0, 0].tolist() == pytest.approx([-0.75, 1.25])
    assert data.soft_joint_pos_limits[1, 2].tolist() == [-math.inf, math.inf]
    assert data.joint_pos_limits[2, 0].tolist() == [-1.0, 1.5]


def test_velocity_limits_are_known_before_the_first_step(make_env):
    assert make_env().scene.robot.data.soft_joint_vel_limits.tolist() == 4 * [[30, 30, 20, 20]]


def _init(**joint_pos):
    return {"pos": [0, 0, 0.3], "rot": [1, 0, 0, 0], "joint_pos": joint_pos, "joint_vel": {".*": 0.0}}


def test_a_default_position_outside_the_limits_is_an_error(make_env):
    with pytest.raises(ConfigError, match=r"left_hip.*outside its limits"):
        make_env(robot={"init_state": _init(left_hip=1.6)})


@pytest.mark.parametrize("value", [-0.3, 0.7])
def test_a_default_position_at_the_limit_is_accepted(make_env, tmp_path, value):
    from sim.small_envs import ASSETS, env_config
    from wheelleg_exp.env import ManagerBasedRLEnv

    text = (ASSETS / "rover.xml").read_text().replace('range="-1 1.5"', 'range="-.3 .7"')
    (tmp_path / "rover.xml").write_text(text)
    config = env_config(robot={"init_state": _init(**{".*_hip": value})})
    env = ManagerBasedRLEnv(config, tmp_path / "rover.xml", 0)
    assert float(env.scene.robot.data.default_joint_pos[0, 0]) == pytest.approx(value)


def test_a_file_in_degrees_gives_radians_for_hinges_and_metres_for_sliders(make_env):
    limits = make_env("arm").scene.robot.data.joint_pos_limits
    assert limits[0, 0].tolist() == pytest.approx([-math.pi / 2, math.pi / 4])
    assert limits[0, 1].tolist() == pytest.approx([-0.1, 0.2])


def test_a_fixed_base_has_its_root_where_the_model_says(make_env):
    env = make_env("arm")
    data = env.scene.robot.data
    assert data.root_pos_w.tolist() == [[0, 0, 1]] * 4
    assert data.root_lin_vel_w.abs().max() == 0
    assert data.projected_gravity_b.tolist() == [[0, 0, -1]] * 4


@pytest.mark.parametrize("event", ["reset_root_state_uniform", "push_by_adding_velocity", "reset_scene_to_default"])
def test_root_events_on_a_fixed_base_do_not_write_into_joints(make_env, event):
    ranges = {
        "reset_root_state_uniform": {"pose_range": {"x": [1, 1]}, "velocity_range": {}},
        "push_by_adding_velocity": {"velocity_range": {"x": [1, 1]}},
        "reset_scene_to_default": {},
    }[event]
    term = {"_target_": f"wheelleg_exp.mdp.events.{event}", "mode": "reset", **ranges}
    try:
        env = make_env("arm", events={"root": term})
        env.reset()
    except ConfigError:
        return
    assert event == "reset_scene_to_default"  # it has joints to reset even where there is no free root
    assert env.scene.robot.data.joint_pos[0].tolist() == pytest.approx([0.1, 0.15])
    assert env.scene.robot.data.joint_vel.abs().max() == 0


def test_two_robots_in_one_file_are_an_error(tmp_path):
    from wheelleg_exp.env import ManagerBasedRLEnv

    body = '<body><freejoint/><geom size=".1"/></body>'
    (tmp_path / "two.xml").write_text(f"<mujoco><worldbody>{body}{body}</worldbody></mujoco>")
    with pytest.raises(AssetError, match="2 robots"):
        ManagerBasedRLEnv(env_config(), tmp_path / "two.xml", 0)


def test_a_file_that_is_no_mjcf_is_an_error(tmp_path):
    from wheelleg_exp.env import ManagerBasedRLEnv

    (tmp_path / "bad.xml").write_text("<mujoco><worldbody>")
    with pytest.raises(AssetError, match="cannot read"):
        ManagerBasedRLEnv(env_config(), tmp_path / "bad.xml", 0)


def test_whole_numbers_are_numbers(make_env):
    """YAML's 30 is as good as 30.0."""
    actuators = make_env().cfg["robot"]["actuators"]
    for group in actuators.values():
        group.update({k: round(v) for k, v in group.items() if isinstance(v, float) and v >= 1})
    actuators["hips"].update(stiffness=20, damping=1, effort_limit=4, velocity_limit=30)
    env = make_env(robot={"actuators": actuators})
    assert env.scene.robot.data.soft_joint_vel_limits.tolist() == 4 * [[30, 30, 20, 20]]


def test_a_joint_driven_twice_is_an_error(make_env):
    actuators = make_env().cfg["robot"]["actuators"]
    actuators["axles"]["joint_names_expr"] = [".*"]
    with pytest.raises(ConfigError, match="driven by both"):
        make_env(robot={"actuators": actuators})


def test_derived_quantities_are_fresh_after_env_step(make_env):
    """Positions and velocities of all bodies equal those of a reference at the new state."""
    env = make_env()
    env.reset()
    env.scene.robot.write_root_velocity_to_sim(
        torch.randn(4, 6, generator=torch.Generator().manual_seed(0)),
        torch.arange(4),
    )
    env.scene.refresh()
    for _ in range(5):
        env.step(torch.ones(4, 4))
    data, model = env.scene.robot.data, env.scene.model
    ids = [model.body(name).id for name in env.scene.robot.body_names]
    for i in range(4):
        reference = mujoco.MjData(model)
        reference.qpos[:] = env.scene.sim.view("qpos")[i].numpy()
        reference.qvel[:] = env.scene.sim.view("qvel")[i].numpy()
        mujoco.mj_forward(model, reference)
        np.testing.assert_allclose(data.body_pos_w[i], reference.xpos[ids], atol=1e-6)
        quat = data.body_quat_w[i].numpy()
        np.testing.assert_allclose(quat, reference.xquat[ids], atol=1e-6)
        for row, body in enumerate(ids):
            velocity = np.zeros(6)  # of the body's CoM, world axes
            mujoco.mj_objectVelocity(model, reference, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
            np.testing.assert_allclose(data.body_ang_vel_w[i, row], velocity[:3], atol=1e-4)
            np.testing.assert_allclose(data.body_lin_vel_w[i, row], velocity[3:], atol=1e-5)


def test_a_joint_without_an_actuator_moves_freely(make_env):
    actuators = make_env().cfg["robot"]["actuators"]
    del actuators["axles"]
    hips = {"_target_": "wheelleg_exp.mdp.actions.JointPositionAction", "joint_names": [".*_hip"]}
    env = make_env(robot={"actuators": actuators}, actions={"a": hips})
    env.reset()
    assert env.scene.model.nu == 2
    env.step(torch.zeros(4, 2))
    assert (env.scene.robot.data.applied_torque[:, 2:] == 0).all()
    assert "left_axle" in str(env.scene_manager)


def test_the_log_tells_the_share_of_robots_that_end_beyond_a_velocity_limit(make_env):
    """PhysX clamps a joint's speed; MuJoCo does not."""
    env = make_env()
    env.reset()
    speed = torch.zeros(4, 4)
    speed[0, 2], speed[3, 0], speed[1, 3] = 20.5, -30.5, 19.5  # rad/s; the limits are 20 of axles and 30 of hips
    env.scene.robot.write_joint_velocity_to_sim(speed)
    assert float(env.reset()[1]["log"]["Diagnostics/joint_over_speed"]) == 0.5
    assert float(env.reset()[1]["log"]["Diagnostics/joint_over_speed"]) == 0.0


# ---- friction ----


def _slides(make_env, push: float, **ground) -> bool:
    env = make_env(
        "block",
        scene={
            "terrain": {"_target_": PLANE, "static_friction": 0.5, "dynamic_friction": 0.3, "restitution": 0} | ground
        },
    )
    env.reset()
    for _ in range(30):
        env.step(torch.zeros(4, 1))
    wrench = torch.zeros(4, 1, 6)
    wrench[:, 0, 0] = push
    env.scene.robot.set_permanent_wrench(torch.arange(4), [0], wrench)
    for _ in range(30):
        env.step(torch.zeros(4, 1))
    return bool((env.scene.robot.data.root_lin_vel_w[:, 0] > 0.1).all())


def test_a_pushed_body_slips_at_the_average_coefficient(make_env):
    """Cube .8, ground .5: it holds up to .65 of its weight, not .8 (MuJoCo's own rule) or .5."""
    weight = 2.001 * 9.81
    assert not _slides(make_env, 0.6 * weight)
    assert _slides(make_env, 0.7 * weight)


def test_the_average_is_with_the_coefficient_that_the_robot_names(make_env):
    env = make_env("block", robot={"friction_source": "dynamic"})
    assert float(env.scene.model.geom("cube").friction[0]) == pytest.approx((0.8 + 0.4) / 2)
    assert env.scene.model.geom("cube").priority[0] > env.scene.model.geom("ground").priority[0]


def _contacts_at_rest(make_env, wanted: bool | None) -> set[frozenset[str]]:
    """Pairs of geoms that touch when one of the rover's arms is so fat that it reaches the other, on the ground."""
    spec = make_env(robot={"self_collisions": wanted}).scene.spec
    spec.geom("left_arm").size[0] = 0.25
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.02
    mujoco.mj_forward(model, data)
    return {frozenset(model.geom(int(g)).name for g in pair) for pair in data.contact.geom}


def test_two_parts_of_the_robot_meet_with_the_greater_of_their_effective_coefficients(tmp_path):
    from wheelleg_exp.env import ManagerBasedRLEnv

    part = "<body name='{n}'><joint name='{n}' axis='0 1 0'/><geom size='.1' friction='{mu}'/></body>"
    (tmp_path / "two.xml").write_text(
        "<mujoco><worldbody><body name='base'><freejoint/><geom size='.01' mass='1'/>"
        f"{part.format(n='a', mu=0.7)}{part.format(n='b', mu=0.3)}</body></worldbody></mujoco>"
    )
    config = env_config(scene={"sensors": {}}, actions={})
    config["robot"] |= {
        "actuators": {},
        "init_state": {"pos": [0, 0, 1], "rot": [1, 0, 0, 0], "joint_pos": {}, "joint_vel": {}},
    }
    model = ManagerBasedRLEnv(config, tmp_path / "two.xml", 0).scene.model
    data = mujoco.MjData(model)
    data.qpos[2] = 1.0
    mujoco.mj_forward(model, data)
    (contact,) = (c for c in data.contact if 0 not in model.geom_bodyid[c.geom])
    assert contact.friction[0] == pytest.approx((0.7 + 0.5) / 2)
    assert sorted(model.geom_friction[contact.geom, 0]) == pytest.approx([0.4, 0.6])


@pytest.mark.parametrize(("wanted", "touch"), [(None, True), (True, True), (False, False)])
def test_the_config_may_switch_the_robots_own_collisions_off_and_not_those_with_the_ground(make_env, wanted, touch):
    pairs = _contacts_at_rest(make_env, wanted)
    assert (frozenset({"left_arm", "right_arm"}) in pairs) is touch
    assert frozenset({"base_box", "ground"}) in pairs


def test_gravity_turned_is_seen_by_the_robot(make_env):
    """Projected gravity is the direction of gravity, not of the world's -z."""
    env = make_env(sim={"gravity": [3.0, 0.0, -4.0]})
    env.reset()
    torch.testing.assert_close(env.scene.robot.data.projected_gravity_b, torch.tensor([[0.6, 0.0, -0.8]]).expand(4, 3))


def test_two_builds_have_the_same_identity_and_another_timestep_has_not(make_env):
    first, second, other = make_env(), make_env(), make_env(sim={"dt": 0.005})
    assert first.scene.model_digest() == second.scene.model_digest()
    assert first.scene.model_digest() != other.scene.model_digest()


def test_the_group_that_rays_ask_for_the_ground_holds_nothing_else(make_env):
    """Geoms of a file that names no group lie in MuJoCo's group 0 until the scene takes it for the ground."""
    model = make_env().scene.model
    assert {model.geom(g).name for g in range(model.ngeom) if model.geom_group[g] == 0} == {"ground"}
    assert set(model.geom_group) == {0, 1}  # both are shown by MuJoCo's viewer
    down = mujoco.mj_ray(model, _placed(model), [0, 0, 1.0], [0, 0, -1.0], np.eye(1, 6, dtype=np.uint8)[0], 1, -1, None)
    assert down == pytest.approx(1.0)  # through the robot


def _placed(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


MESH = """<mujoco><asset><mesh name="t" file="t.obj"/></asset>
<worldbody><body><freejoint/><geom type="mesh" mesh="t" mass="{mass}"/></body></worldbody></mujoco>"""


def _digest_in(folder: Path, mass: float = 1.0) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (folder / "m.xml").write_text(MESH.format(mass=mass))
    return model_digest(mujoco.MjModel.from_xml_path(str(folder / "m.xml")))


def test_the_identity_does_not_depend_on_where_the_meshes_lie(tmp_path):
    assert _digest_in(tmp_path / "here") == _digest_in(tmp_path / "somewhere_else")
    assert _digest_in(tmp_path / "here") != _digest_in(tmp_path / "here", mass=1.0000001)


@pytest.mark.parametrize("section", ["sim", "scene", "robot"])
def test_an_unknown_key_of_a_section_is_an_error(make_env, section):
    with pytest.raises(ConfigError, match="colour"):
        make_env(**{section: {"colour": 1}})


def test_a_missing_key_of_a_section_is_an_error():
    from sim.small_envs import ASSETS, env_config
    from wheelleg_exp.env import ManagerBasedRLEnv

    config = env_config()
    del config["sim"]["impratio"]
    with pytest.raises(ConfigError, match="impratio"):
        ManagerBasedRLEnv(config, ASSETS / "rover.xml", 0)


def test_a_fixed_base_stands_where_the_config_says(make_env):
    init = make_env("arm").cfg["robot"]["init_state"]
    env = make_env("arm", robot={"init_state": init | {"pos": [0.3, -0.2, 0.7], "rot": [0.0, 0.0, 0.0, 1.0]}})
    data = env.scene.robot.data
    assert data.root_pos_w[0].tolist() == pytest.approx([0.3, -0.2, 0.7])
    assert data.root_quat_w[0].abs().tolist() == pytest.approx([0.0, 0.0, 0.0, 1.0])
