import math

import mujoco
import numpy as np
import pytest
import torch
from lint.test_coupled_loads import AHEAD, HIP, bent, robot
from sim.small_envs import ACTUATORS, env_config, env_of, init_state, run, variant

from mdp.nodes import bodies, event, joints
from mdp.test_curriculums import TILES
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.mdp import events
from wheelleg_exp.mdp.root_motion import resting_side
from wheelleg_exp.sim import rotation

ALL = torch.arange(4)


MATERIAL = {"static_friction_range": [0.6, 1.2], "dynamic_friction_range": [0.5, 1.0]}
MATERIAL |= {"restitution_range": [0.0, 0.05], "num_buckets": 8}
CONSISTENT = {"make_consistent": True}


def test_each_shape_gets_the_average_of_a_bucket_and_the_ground(make_env):
    env = make_env(events={"m": event("randomize_rigid_body_material", **MATERIAL)}, num_envs=50)
    term = env.event_manager.get_term_cfg("m").func
    friction = torch.from_numpy(np.array(env.scene.sim.batch.expanded("geom_friction")))
    model = env.scene.model
    written = friction[:, [g for g in range(model.ngeom) if model.geom_bodyid[g] > 0], 0]
    assert (written.unsqueeze(2) - (term.buckets[:, 0].double() + 0.5) / 2).abs().amin(dim=2).max() < 1e-6
    assert ((written >= 0.55) & (written <= 0.85)).all()
    assert len(written.unique()) == 8
    assert (written != written[:, :1]).any()
    assert (friction[:, model.geom("ground").id, 0] == model.geom("ground").friction[0]).all()
    assert (friction[:, :, 1:] == torch.from_numpy(model.geom_friction[:, 1:])).all()
    assert ((term.buckets[:, 2] >= 0) & (term.buckets[:, 2] <= 0.05)).all()


def test_the_dynamic_coefficient_is_written_if_the_robot_names_it(make_env):
    node = event("randomize_rigid_body_material", **MATERIAL | {"dynamic_friction_range": [0.2, 0.2]})
    env = make_env(events={"m": node}, robot={"friction_source": "dynamic"})
    friction = env.scene.sim.batch.expanded("geom_friction")
    assert friction[0, env.scene.model.geom("left_wheel").id, 0] == pytest.approx((0.2 + 0.4) / 2)


def test_coefficients_are_combined_by_the_mode_of_the_robot(make_env):
    node = event("randomize_rigid_body_material", **MATERIAL | {"static_friction_range": [0.3, 0.3]})
    env = make_env(events={"m": node}, robot={"friction_combine_mode": "multiply"})
    friction = env.scene.sim.batch.expanded("geom_friction")
    assert friction[0, env.scene.model.geom("left_wheel").id, 0] == pytest.approx(0.3 * 0.5)


def test_only_shapes_of_the_configured_bodies_are_written(make_env):
    env = make_env(events={"m": event("randomize_rigid_body_material", **MATERIAL, asset_cfg=bodies(".*_wheel"))})
    friction, model = env.scene.sim.batch.expanded("geom_friction"), env.scene.model
    assert friction[0, model.geom("base_box").id, 0] == pytest.approx((0.9 + 0.5) / 2)
    assert friction[0, model.geom("left_wheel").id, 0] != pytest.approx((1.0 + 0.5) / 2)


def test_dynamic_friction_can_exceed_static_unless_made_consistent(make_env):
    nodes = (event("randomize_rigid_body_material", **MATERIAL | {"num_buckets": 500, **o}) for o in ({}, CONSISTENT))
    loose, tight = (make_env(events={"m": n}).event_manager.get_term_cfg("m").func.buckets for n in nodes)
    assert (loose[:, 1] > loose[:, 0]).any()
    assert (tight[:, 1] <= tight[:, 0]).all()
    assert torch.equal(loose[:, 0], tight[:, 0])


def _mass(make_env, operation, params, **fields):
    fields |= {"operation": operation, "mass_distribution_params": params, "asset_cfg": bodies("base", "left_wheel")}
    env = make_env(events={"m": event("randomize_rigid_body_mass", **fields)}, num_envs=200)
    model = env.scene.model
    ids = [model.body("base").id, model.body("left_wheel").id]
    mass, inertia = (env.scene.sim.batch.expanded(field) for field in ("body_mass", "body_inertia"))
    return env, model, ids, mass.copy(), inertia


@pytest.mark.parametrize(
    ("operation", "params", "low", "high"),
    [
        ("add", [-0.05, 0.1], [1.15, 0.05], [1.3, 0.2]),
        ("scale", [0.5, 2.0], [0.6, 0.05], [2.4, 0.2]),
        ("abs", [3.0, 4.0], [3.0, 3.0], [4.0, 4.0]),
    ],
)
def test_masses_are_drawn_from_the_default_for_each_environment_and_body(make_env, operation, params, low, high):
    env, model, ids, mass, inertia = _mass(make_env, operation, params)
    drawn = mass[:, ids]
    assert ((drawn >= np.array(low) - 1e-6) & (drawn <= np.array(high) + 1e-6)).all()
    assert len(np.unique(drawn)) == drawn.size
    others = [b for b in range(model.nbody) if b not in ids]
    assert (mass[:, others] == model.body_mass[others]).all()
    np.testing.assert_allclose(inertia[:, ids], model.body_inertia[ids] * (drawn / model.body_mass[ids])[..., None])
    assert env.scene.sim.batch.expanded("body_ipos") is None  # centres of mass stay


def test_masses_drawn_again_do_not_add_up(make_env):
    env, _, ids, mass, inertia = _mass(make_env, "add", [0.1, 0.1], recompute_inertia=False)
    assert inertia is None
    env.event_manager.apply("startup")
    np.testing.assert_allclose(np.array(env.scene.sim.batch.expanded("body_mass"))[:, ids], mass[:, ids])


def test_a_mass_never_falls_below_its_minimum(make_env):
    *_, ids, mass, _ = _mass(make_env, "add", [-5.0, -5.0], min_mass=0.25)
    assert (mass[:, ids] == 0.25).all()


@pytest.mark.parametrize("what", ["mass", "inertia"])
def test_values_derived_from_mass_and_inertia_are_mujocos(start_env, what):
    params = {f"{what}_distribution_params": [2.0, 2.0], "operation": "scale", "asset_cfg": bodies("base")}
    env = start_env(events={"e": event(f"randomize_rigid_body_{what}", mode="custom", **params)})
    model, sim = env.scene.model, env.scene.sim
    before = sim.derived("subtree_com")[:, model.body("base").id].clone()
    base = sim.derived("xipos")[:, model.body("base").id].clone()
    env.apply_event("custom", torch.tensor([1]))
    changed = model.__copy__()
    changed.body_inertia[model.body("base").id] *= 2.0
    changed.body_mass[model.body("base").id] *= 2.0 if what == "mass" else 1.0
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    for field in ("dof_invweight0", "body_invweight0"):
        np.testing.assert_allclose(sim.batch.expanded(field)[1], getattr(changed, field), rtol=1e-9)
        np.testing.assert_allclose(sim.batch.expanded(field)[0], getattr(model, field), rtol=1e-9)
    added = model.body("base").mass[0] if what == "mass" else 0.0
    expected = before[1] + (base[1] - before[1]) * added / (model.body_mass.sum() + added)
    torch.testing.assert_close(sim.derived("subtree_com")[1, model.body("base").id], expected)


def test_the_drawn_mass_is_what_the_engine_moves(start_env):
    ranges = {"operation": "add", "mass_distribution_params": [0.0, 3.0], "asset_cfg": bodies("block")}
    env = start_env("block", events={"m": event("randomize_rigid_body_mass", **ranges)})
    run(env, 60)
    mass = np.array(env.scene.sim.batch.expanded("body_mass")).sum(axis=1)
    np.testing.assert_allclose(env.scene["contact"].data.net_forces_w[:, 0, 2], mass * 9.81, atol=0.05)


@pytest.mark.parametrize("what", ["mass", "inertia"])
def test_a_gaussians_deviation_can_be_less_than_its_mean(make_env, what):
    params = {f"{what}_distribution_params": [0.5, 0.01], "operation": "abs", "distribution": "gaussian"}
    env = make_env(events={"m": event(f"randomize_rigid_body_{what}", asset_cfg=bodies("base"), **params)})
    assert (env.scene.sim.expanded[f"body_{what}"][:, env.scene.model.body("base").id] - 0.5).abs().max() < 0.06


@pytest.mark.parametrize(
    ("distribution", "mean", "std"),
    [("uniform", 3.0, 2 / math.sqrt(12)), ("gaussian", 2.0, 4.0), ("log_uniform", 2 / math.log(2), None)],
)
def test_distributions(distribution, mean, std):
    drawn = events.draw(2.0, 4.0, (40000,), distribution, torch.Generator().manual_seed(0))
    assert float(drawn.mean()) == pytest.approx(mean, abs=0.05)
    if std is not None:
        assert float(drawn.std()) == pytest.approx(std, abs=0.05)
    else:
        assert float(drawn.log().mean()) == pytest.approx(1.5 * math.log(2), abs=0.01)
        assert 2.0 <= float(drawn.min()) < 2.01
        assert 3.99 < float(drawn.max()) <= 4.0


def test_centres_of_mass_shift_together_and_add_up(start_env):
    ranges = {"x": [-0.01, 0.02], "y": [0.005, 0.005]}
    fields = {"mode": "custom", "com_range": ranges, "asset_cfg": bodies("base", "left_arm")}
    env = start_env(events={"c": event("randomize_rigid_body_com_cumulative", **fields)})
    model = env.scene.model
    ids = [model.body("base").id, model.body("left_arm").id]
    env.apply_event("custom")
    once = np.array(env.scene.sim.batch.expanded("body_ipos")) - model.body_ipos
    assert ((once[:, ids, 0] >= -0.01) & (once[:, ids, 0] <= 0.02)).all()
    np.testing.assert_allclose(once[:, ids, 1], 0.005, atol=1e-7)
    np.testing.assert_allclose(once[:, ids[0]], once[:, ids[1]], atol=1e-15)  # all listed bodies have one offset
    assert len(np.unique(once[:, ids[0], 0])) == 4
    env.apply_event("custom", torch.tensor([2]))
    twice = np.array(env.scene.sim.batch.expanded("body_ipos")) - model.body_ipos
    np.testing.assert_allclose(twice[:, ids[0], 1], [0.005, 0.005, 0.01, 0.005], atol=1e-7)
    expected = torch.from_numpy(model.body_ipos[ids[0]] + twice[:, ids[0]])
    torch.testing.assert_close(env.scene.robot.data.com_b.double(), expected, atol=1e-7, rtol=0)


def test_wrenches_are_drawn_within_their_ranges_for_the_configured_bodies(start_env):
    ranges = {"force_range": [1.0, 2.0], "torque_range": [-0.2, -0.1], "asset_cfg": bodies("base", "right_arm")}
    env = start_env(events={"w": event("apply_external_force_torque", mode="reset", **ranges)}, num_envs=64)
    env.step(torch.zeros(64, 4))
    applied = env.scene.robot._wrench  # link axes, (N, bodies, 3, [force, torque])
    named = [env.scene.robot.body_names.index(n) for n in ("base", "right_arm")]
    force, torque = applied[:, named, :, 0], applied[:, named, :, 1]
    assert ((force >= 1.0) & (force <= 2.0)).all()
    assert ((torque >= -0.2) & (torque <= -0.1)).all()
    assert len(force.unique()) == force.numel()
    assert (applied[:, [b for b in range(5) if b not in named]] == 0).all()


RANGES = {"x": [1.0, 1.0], "y": [-2.0, -2.0], "yaw": [0.5, 0.5]}
REACHED = pytest.approx([0.7, 0.7, 0.5, 0.5])
MOVING = [0.1, 0.2, 0.3, 1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("push_by_adding_velocity", [1.1, -1.8, 0.3, 1.0, 2.0, 3.5]),
        ("push_by_setting_velocity", [1.1, -1.8, 0.3, 1.0, 2.0, 3.5]),
        ("set_root_velocity", [1.0, -2.0, 0.0, 0.0, 0.0, 0.5]),
    ],
)
def test_a_push_adds_to_the_velocity_of_the_com_in_world_axes_or_sets_it(start_env, name, expected):
    env = start_env(events={"p": event(name, mode="custom", velocity_range=RANGES)})
    robot = env.scene.robot
    quat = torch.nn.functional.normalize(torch.tensor([[1.0, 0.5, -0.3, 0.2]]), dim=1).expand(4, 4)
    robot.write_root_pose_to_sim(torch.cat((robot.data.root_pos_w.clone(), quat), dim=1), ALL)
    robot.write_root_velocity_to_sim(torch.tensor([MOVING] * 4), ALL)
    env.apply_event("custom", torch.tensor([0, 2]))
    torch.testing.assert_close(robot.data.root_vel_w, torch.tensor([expected, MOVING] * 2), atol=1e-5, rtol=0)


def test_a_push_in_the_yaw_frame_turns_with_the_robot(start_env):
    """The four robots have the yaw angles 0, 90, 180, and -30 degrees. The second and third robots are pushed."""
    ranges = {"x": [1.0, 1.0], "y": [-2.0, -2.0], "z": [3.0, 3.0], "roll": [4.0, 4.0], "yaw": [0.5, 0.5]}
    env = start_env(events={"p": event("push_by_adding_velocity", mode="custom", velocity_range=ranges, frame="yaw")})
    yaw = torch.tensor([0.0, math.pi / 2, math.pi, -math.pi / 6])
    pitch = torch.full((4,), 0.3)  # a leaning robot is pushed along the ground, too
    pose = (env.scene.robot.data.root_pos_w, rotation.quat_from_euler_xyz(torch.zeros(4), pitch, yaw))
    env.scene.robot.write_root_pose_to_sim(torch.cat(pose, dim=1), ALL)
    env.scene.robot.write_root_velocity_to_sim(torch.zeros(4, 6), ALL)
    env.apply_event("custom", torch.tensor([1, 2]))
    moved = torch.tensor([[0.0, 0.0, 0.0], [2.0, 1.0, 3.0], [-1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    turned = torch.tensor([[0.0, 0.0, 0.0], [0.0, 4.0, 0.5], [-4.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(env.scene.robot.data.root_lin_vel_w, moved, atol=1e-5, rtol=0)
    torch.testing.assert_close(env.scene.robot.data.root_ang_vel_w, turned, atol=1e-5, rtol=0)


def _placed(start_env, name="reset_root_state_uniform", rot=(1.0, 0.0, 0.0, 0.0), num_envs=4, **ranges):
    init = {"pos": [0.1, 0.2, 0.5], "rot": list(rot), "joint_pos": {".*": 0.0}, "joint_vel": {".*": 0.0}}
    env = start_env(events={"p": event(name, mode="reset", **ranges)}, robot={"init_state": init}, num_envs=num_envs)
    return env, env.scene.robot.data


def test_the_drawn_angles_turn_the_default_orientation_in_body_axes(start_env):
    rot, angles = (0.8, 0.0, 0.6, 0.0), (0.3, -0.2, 0.5)
    pose = {name: [angle, angle] for name, angle in zip(("roll", "pitch", "yaw"), angles, strict=True)}
    _, data = _placed(start_env, rot=rot, pose_range=pose, velocity_range={})
    turn, expected = np.zeros(4), np.zeros(4)
    mujoco.mju_euler2Quat(turn, np.array(angles), "XYZ")
    mujoco.mju_mulQuat(expected, np.array(rot), turn)
    np.testing.assert_allclose(data.root_quat_w[0], expected, atol=1e-6)


def test_the_drawn_velocity_is_that_of_the_com_in_world_axes(start_env):
    velocity = {"x": [1.0, 1.0], "z": [2.0, 2.0], "pitch": [3.0, 3.0]}
    _, data = _placed(start_env, rot=(0.8, 0.6, 0.0, 0.0), pose_range={"yaw": [1.0, 1.0]}, velocity_range=velocity)
    torch.testing.assert_close(data.root_lin_vel_w, torch.tensor([[1.0, 0.0, 2.0]] * 4), atol=1e-5, rtol=0)
    torch.testing.assert_close(data.root_ang_vel_w, torch.tensor([[0.0, 3.0, 0.0]] * 4), atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["reset_root_state_uniform", "reset_root_state_with_random_orientation"])
def test_episodes_start_at_a_default_state_that_was_changed(start_env, name):
    half = math.sqrt(0.5)
    env, data = _placed(start_env, name, pose_range={"x": [0.5, 0.5]}, velocity_range={"z": [2.0, 2.0]})
    data.default_root_state[1] = torch.tensor([1.0, 2.0, 3.0, half, 0.0, 0.0, half, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    env.reset()
    torch.testing.assert_close(data.root_pos_w[1], env.scene.env_origins[1] + torch.tensor([1.5, 2.0, 3.0]))
    torch.testing.assert_close(data.root_pos_w[0], env.scene.env_origins[0] + torch.tensor([0.6, 0.2, 0.5]))
    torch.testing.assert_close(data.root_vel_w[1], torch.tensor([0.1, 0.2, 2.3, 0.4, 0.5, 0.6]), atol=1e-5, rtol=0)
    torch.testing.assert_close(data.root_vel_w[0], torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]), atol=1e-5, rtol=0)
    if name == "reset_root_state_uniform":
        torch.testing.assert_close(data.root_quat_w[1], torch.tensor([half, 0.0, 0.0, half]))


def test_draws_are_independent_between_axes_and_environments(start_env):
    env, data = _placed(start_env, num_envs=400, pose_range={"x": [-1, 1], "y": [-1, 1]}, velocity_range={})
    offset = data.root_pos_w - env.scene.env_origins - torch.tensor([0.1, 0.2, 0.5])
    assert offset[:, :2].abs().max() <= 1 + 1e-4
    assert abs(float(torch.corrcoef(offset[:, :2].T)[0, 1])) < 0.15
    assert float(offset[:, 0].std()) == pytest.approx(2 / math.sqrt(12), abs=0.05)


def test_random_orientations_cover_the_sphere(start_env):
    name = "reset_root_state_with_random_orientation"
    _, data = _placed(start_env, name, num_envs=500, pose_range={}, velocity_range={})
    up = rotation.quat_to_matrix(data.root_quat_w)[:, 2, 2]
    torch.testing.assert_close(data.root_quat_w.norm(dim=1), torch.ones(500))
    # The z axis of a uniform rotation has uniform height on [-1, 1]: mean 0, variance 1/3.
    assert float(up.min()) < -0.9 < 0.9 < float(up.max())
    assert (float(up.mean()), float(up.var())) == (pytest.approx(0.0, abs=0.1), pytest.approx(1 / 3, abs=0.05))


def _joint_reset(start_env, kind, position, velocity, defaults=0.5, speed=2.0, **fields):
    init = {"pos": [0, 0, 1], "rot": [1, 0, 0, 0], "joint_pos": {".*": defaults}, "joint_vel": {".*": speed}}
    node = event(f"reset_joints_by_{kind}", mode="reset", position_range=position, velocity_range=velocity, **fields)
    return start_env(events={"j": node}, robot={"init_state": init}, num_envs=100).scene.robot.data


def test_joints_by_scale(start_env):
    assert (_joint_reset(start_env, "scale", [1.0, 1.0], [-0.2, 0.2], speed=0.0).joint_vel == 0).all()
    data = _joint_reset(start_env, "scale", [0.5, 1.5], [-1.0, 1.0])
    assert ((data.joint_pos >= 0.25 - 1e-6) & (data.joint_pos <= 0.75 + 1e-6)).all()
    assert ((data.joint_vel >= -2 - 1e-6) & (data.joint_vel <= 2 + 1e-6)).all()
    assert len(data.joint_pos.unique()) == 400
    both = torch.stack((data.joint_pos.flatten(), data.joint_vel.flatten()))
    assert abs(float(torch.corrcoef(both)[0, 1])) < 0.2  # position and speed of a joint have separate draws


@pytest.mark.parametrize(
    ("position", "velocity", "fields", "reached", "speeds"),
    [
        ([5.0, 5.0], [100.0, 100.0], {}, [1.5, 1.5, 5.5, 5.5], [30, 30, 20, 20]),
        ([0.2, 0.2], [1.0, 1.0], {"speed": 0.0, "asset_cfg": joints(".*_hip")}, REACHED, [1, 1, 0, 0]),
    ],
)
def test_configured_joints_are_reset_within_their_limits(start_env, position, velocity, fields, reached, speeds):
    data = _joint_reset(start_env, "offset", position, velocity, **fields)
    assert (data.joint_pos[0].tolist(), data.joint_vel[0].tolist()) == (reached, speeds)


COUPLED = """</worldbody><equality>
  <joint joint1="left_axle" joint2="right_hip" polycoef="0.1 2 0 -1 0.5"/>
  <joint joint1="right_hip" joint2="left_hip" polycoef="0.3 -1.5 0.2 0 0"/></equality>"""


def coupled_env(folder, default=0.2, **ranges):
    node = event("reset_joints_by_offset", mode="reset", **ranges)
    robot = {"init_state": init_state(0.3, {"left_hip": 0.2, "right_hip": default, ".*_axle": 0.0})}
    file = variant(folder, "</worldbody>", COUPLED)
    return env_of(file, env_config(robot=robot, events={"joints": node}, num_envs=64))


@pytest.mark.parametrize("names", [{}, {"asset_cfg": joints("left_hip")}])
def test_random_resets_draw_the_driver_and_set_the_joints_that_follow_it(tmp_path, names):
    env = coupled_env(tmp_path, 0.0, position_range=[-0.6, 3.0], velocity_range=[-1.0, 1.0], **names)
    env.reset()
    model, data = env.scene.model, env.scene.robot.data
    left, right = (data.joint_names.index(name) for name in ("left_hip", "right_hip"))
    drawn = data.joint_pos[:, left]
    assert len(drawn.unique()) > 20
    # The right hip stays above its lower limit -1: 0.3 - 1.5 q + 0.2 q² > -1.
    assert drawn.max() == pytest.approx((1.5 - math.sqrt(1.5**2 - 4 * 0.2 * 1.3)) / 0.4, abs=1e-3)
    assert data.joint_pos[:, right].min() >= -1.0 - 1e-6
    for qpos, qvel in zip(env.scene.sim.view("qpos"), env.scene.sim.view("qvel"), strict=True):
        found = mujoco.MjData(model)
        found.qpos, found.qvel = qpos.numpy(), qvel.numpy()
        mujoco.mj_forward(model, found)
        couplings = found.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert couplings.sum() == 2
        assert found.efc_pos[couplings] == pytest.approx(0.0, abs=1e-5)
        assert found.efc_vel[couplings] == pytest.approx(0.0, abs=1e-5)


def test_random_resets_of_closed_loops_move_the_motors_and_close_the_loops(tmp_path):
    (tmp_path / "loop.xml").write_text(robot("loop", {}))
    pose = dict(
        zip(("f_hip", "f_knee", "b_hip", "b_knee"), (*bent(AHEAD - HIP, 1), *bent(AHEAD + HIP, -1)), strict=True)
    )
    motors = {"_target_": ACTUATORS + "ImplicitActuator", "joint_names_expr": [".*_hip"], "stiffness": 50.0,
              "damping": 1.0, "effort_limit": 20.0, "velocity_limit": 20.0}  # fmt: skip
    init = init_state(0.4, {f"._{name}": position for name, position in pose.items()})
    node = event("reset_joints_by_offset", mode="reset", position_range=[-0.1, 0.1], velocity_range=[-1.0, 1.0])
    changes = {"asset": "loop.xml", "init_state": init, "actuators": {"hips": motors}}
    config = env_config(robot=changes, actions={}, events={"joints": node}, num_envs=64)
    env = env_of(tmp_path / "loop.xml", config)
    env.reset()
    data = env.scene.robot.data
    hips = [index for index, name in enumerate(data.joint_names) if name.endswith("hip")]
    moved = (data.joint_pos - data.default_joint_pos)[:, hips]
    assert 0.09 < moved.abs().max() < 0.1001
    for qpos, qvel in zip(env.scene.sim.view("qpos"), env.scene.sim.view("qvel"), strict=True):
        found = mujoco.MjData(env.scene.model)
        found.qpos, found.qvel = qpos.numpy(), qvel.numpy()
        mujoco.mj_forward(env.scene.model, found)
        loops = found.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        # Drawn alone, the joints open the loops by up to 60 mm, and the points separate with up to 0.7 m/s.
        assert np.abs(found.efc_pos[loops]).max() < 0.5e-3
        assert np.abs(found.efc_vel[loops]).max() < 0.04


def test_default_positions_satisfy_the_couplings(tmp_path):
    still = {"position_range": [0.0, 0.0], "velocity_range": [0.0, 0.0]}
    data = coupled_env(tmp_path, 0.005, **still).scene.robot.data
    right = 0.3 - 1.5 * 0.2 + 0.2 * 0.2**2
    by_name = dict(zip(data.joint_names, data.default_joint_pos[0].tolist(), strict=True))
    assert by_name["right_hip"] == pytest.approx(right)
    assert by_name["left_axle"] == pytest.approx(0.1 + 2 * right - right**3 + 0.5 * right**4)
    with pytest.raises(ConfigError, match=r"0\.2 of joint 'right_hip' breaks a coupling.*0\.008"):
        coupled_env(tmp_path, **still)


def test_joints_are_clamped_to_their_soft_limits(start_env):
    """The hips' limits of -1 and 1.5 rad shrink by the factor 0.8 around their middle."""
    node = event("reset_joints_by_offset", mode="reset", position_range=[-9.0, 9.0], velocity_range=[0.0, 0.0])
    env = start_env(events={"j": node}, robot={"soft_joint_pos_limit_factor": 0.8}, num_envs=20)
    hips = env.scene.robot.data.joint_pos[:, :2]
    assert (float(hips.min()), float(hips.max())) == (pytest.approx(-0.75), pytest.approx(1.25))


@pytest.mark.parametrize("targets", [True, False])
def test_everything_returns_to_its_default(make_env, targets):
    env = make_env(events={"d": event("reset_scene_to_default", mode="reset", reset_joint_targets=targets)})
    data = env.scene.robot.data
    data.default_root_state[2, 7] = 0.5  # m/s
    env.reset()
    start = env.scene.sim.view("qpos").clone()
    run(env, 20, 1.0)
    env.reset()
    torch.testing.assert_close(env.scene.sim.view("qpos"), start, atol=1e-7, rtol=0)
    torch.testing.assert_close(data.root_vel_w, torch.eye(6)[0] * torch.tensor([[0.0], [0.0], [0.5], [0.0]]))
    assert data.joint_vel.abs().max() == 0
    torch.testing.assert_close(data.root_pos_w, env.scene.env_origins + torch.tensor([0.0, 0.0, 0.3]))
    assert torch.equal(data.joint_pos_target, data.default_joint_pos) == targets
    assert torch.equal(data.joint_vel_target, data.default_joint_vel) == targets


def test_a_robot_rests_in_the_poses_in_which_it_is_laid_down(start_env):
    node = event("reset_to_resting_pose", mode="reset", num_poses=20)
    env = start_env(events={"lie": node}, num_envs=30, robot={"actuators": {}})
    data = env.scene.robot.data
    start, up = data.root_pos_w.clone(), rotation.quat_to_matrix(data.root_quat_w)[:, :, 2].clone()
    assert len(up[:, 2].unique()) > 5
    for _ in range(20):
        run(env, 1)
    turned = rotation.quat_to_matrix(data.root_quat_w)[:, :, 2]
    rests = ((data.root_pos_w - start)[:, 2].abs() < 0.01) & ((turned * up).sum(dim=1) > 0.97)
    assert float(rests.float().mean()) > 0.9


def test_some_robots_have_the_pose_of_earlier_events(start_env):
    node = event("reset_to_resting_pose", mode="reset", num_poses=5, share=0.4)
    env = start_env(events={"lie": node}, num_envs=500)
    data = env.scene.robot.data
    stands = (data.root_pos_w[:, 2] - data.default_root_state[:, 2]).abs() < 1e-6
    assert float(stands.float().mean()) == pytest.approx(0.6, abs=0.07)


def test_each_side_on_which_the_robot_can_lie_can_be_equally_likely(start_env):
    node = event("reset_to_resting_pose", mode="reset", num_poses=40, by_side=True)
    env = start_env(events={"lie": node}, num_envs=1000)
    shares = torch.bincount(resting_side(env.scene.robot.data.projected_gravity_b)) / 1000
    shares = shares[shares > 0]
    assert len(shares) > 1
    assert shares.tolist() == pytest.approx([1 / len(shares)] * len(shares), abs=0.06)


def test_a_robot_can_only_be_laid_down_on_level_ground(start_env):
    node = event("reset_to_resting_pose", mode="reset", num_poses=2)
    with pytest.raises(ConfigError, match="level ground"):
        start_env(events={"lie": node}, scene={"terrain": TILES})
