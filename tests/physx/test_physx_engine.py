"""Compare PhysX with MuJoCo and with closed forms. ``nox -s physx`` runs these tests in a separate environment."""

import math
import shutil

import pytest
import torch
from physics.worlds import depth_in_step

from wheelleg_exp.build import build_env, prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab.utils.math import quat_apply
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.sim.physx.physx_engine import PhysxEngine

pytest.importorskip("ovphysx")

G, DT, RADIUS = 9.81, 1.0 / 120.0, 0.02  # m/s², s, m; radius of the wheels
ENGINES = ("mujoco", "physx")


def build(engine, *words, num_envs=2, robot="physical"):
    flat = ["task=stand", f"robot={robot}", f"env.num_envs={num_envs}", f"env.sim.engine={engine}"]
    return build_env(compose([*flat, *words]).config)


def flying(env, spin=0.0):
    """Lift the robots to 1 m, turn them, and give them velocities that differ between joints and environments."""
    robot = env.scene.robot
    generator = torch.Generator().manual_seed(3)
    state = robot.data.default_root_state.clone()
    state[:, :3] = env.scene.env_origins + torch.tensor([0.0, 0.0, 1.0])
    state[:, 3:7] = torch.nn.functional.normalize(torch.tensor([[0.9, 0.1, -0.3, 0.2]]), dim=1)
    state[:, 7:] = torch.randn(env.num_envs, 6, generator=generator) * torch.tensor([0.5] * 3 + [spin] * 3)
    robot.write_root_state_to_sim(state)
    speeds = 0.3 * torch.randn(env.num_envs, robot.num_joints, generator=generator)
    robot.write_joint_state_to_sim(robot.data.default_joint_pos, speeds)
    targets = robot.data.default_joint_pos + 0.05 * torch.randn(speeds.shape, generator=generator)
    robot.set_joint_position_target(targets)
    robot.set_joint_velocity_target(torch.randn(speeds.shape, generator=generator))
    env.scene.refresh()


def lift(env, height, quat=None):
    """Place the robots at a height above their origins, m."""
    state = env.scene.robot.data.default_root_state.clone()
    state[:, :3] = env.scene.env_origins + torch.tensor([0.0, 0.0, height])
    state[:, 3:7] = state[:, 3:7] if quat is None else quat
    env.scene.robot.write_root_state_to_sim(state)
    env.scene.refresh()


def advance(env, steps):
    for _ in range(steps):
        env.scene.write_data_to_sim()
        env.scene.sim.step()
        env.scene.update()


LIMITS = (4e-4, 2e-3, 8e-3, 0.04, 3.5e-3, 0.12)  # m, of quaternions, m/s, rad/s, rad, rad/s


def flight(env):
    """Return position, orientation, velocities, joint positions and joint velocities after a flight of 0.2 s."""
    flying(env, spin=2.0)
    advance(env, 24)
    data = env.scene.robot.data
    # After a time t, an integrator with n velocity updates per step dt is g t dt / (2 n) below the parabola. MuJoCo has
    # one update, and PhysX has eight: the solver iterations of the USD file.
    pos = data.root_pos_w.clone()
    pos[:, 2] += G * 24 * DT * DT / 2.0 / (1 if env.scene.sim.name == "mujoco" else 8)
    others = (data.root_quat_w, data.root_lin_vel_w, data.root_ang_vel_w, data.joint_pos, data.joint_vel)
    return [pos, *(values.clone() for values in others)]


def worst(ours, theirs):
    """Return the largest difference of two flights, as a multiple of its limit."""
    return max(float((a - b).abs().max()) / limit for a, b, limit in zip(ours, theirs, LIMITS, strict=True))


TURNED = "+env.robot.root_frame=[0.8,0.0,0.36,0.48]"
MOVED = "+env.events.coms={_target_:wheelleg_exp.mdp.events.randomize_rigid_body_com,mode:startup,"
MOVED += "com_range:{x:[0.02,0.02],y:[0.0,0.0],z:[0.03,0.03]},asset_cfg:{_target_:wheelleg_exp.managers.SceneEntityCfg,"
MOVED += "name:robot,body_names:[base_link]}}"


@pytest.mark.parametrize("words", [["robot=article"], ["robot=physical"], [TURNED], [TURNED, MOVED]])
def test_a_flying_robot_with_driven_joints_moves_as_in_mujoco(words):
    assert worst(*(flight(build(engine, *words)) for engine in ("mujoco", "physx"))) < 1.0


WHEEL_AXIS = """axis = "Y"
            rel physics:body0 = </wheelleg/wl2/l_shank_link>"""


@pytest.mark.parametrize(
    ("right", "wrong", "named"),
    [
        (
            "diagonalInertia = (0.000144573333, 0.000179573333,",
            "diagonalInertia = (0.000289146666, 0.000359146666,",
            "inertia of base_link (",
        ),
        (
            "centerOfMass = (0, 0, -0.02125)",
            "centerOfMass = (0, 0, -0.05)",
            "centre of mass of l_thigh_link (29 mm away)",
        ),
        ('axis = "Y"', 'axis = "X"', "position of "),
        ("localPos0 = (0, 0.04, 0)", "localPos0 = (0, 0.08, 0)", "position of "),
        ("l_thigh_link", "r_thigh_link", "position of "),
        (WHEEL_AXIS, WHEEL_AXIS.replace('"Y"', '"Z"'), "orientation of l_wheel_link"),
    ],
)
def test_errors_of_the_conversion_become_visible(tmp_path, right, wrong, named):
    shutil.copytree(assets_dir() / "wheelleg", tmp_path / "wheelleg")
    physics = tmp_path / "wheelleg/configuration/wheelleg_physics.usda"
    text = physics.read_text()
    assert right in text
    if "thigh" in right:  # Exchange the left and the right hip.
        text = text.replace('def PhysicsRevoluteJoint "l01"', 'def PhysicsRevoluteJoint "x01"')
        text = text.replace('def PhysicsRevoluteJoint "r01"', 'def PhysicsRevoluteJoint "l01"')
        physics.write_text(text.replace('def PhysicsRevoluteJoint "x01"', 'def PhysicsRevoluteJoint "r01"'))
    else:
        physics.write_text(text.replace(right, wrong, 1))
    config = compose(["task=stand", "robot=physical", "env.num_envs=2", "env.sim.engine=physx"]).config
    config["env"]["robot"]["asset"] = str(tmp_path / "wheelleg/wheelleg.usda")
    mjcf = prepare_asset(compose(["task=stand", "robot=physical"]).config).output
    wrongly = ManagerBasedRLEnv(config["env"], mjcf, 0)
    assert worst(flight(build("mujoco")), flight(wrongly)) > 1.2
    found = wrongly.scene.sim.robot_differences()
    assert any(text.startswith(named) for text in found)


@pytest.mark.parametrize(
    ("quantity", "factor", "named"),
    [
        ("DOF_ARMATURE", 0.0, "armature of l01 and 5 more (0 times)"),
        ("DOF_STIFFNESS", 2.0, "stiffness of l01 and 3 more (2 times)"),
        ("SHAPE_FRICTION_AND_RESTITUTION", 0.5, "friction and restitution of base_link and 6 more (0.5 times)"),
        ("", 1.0, None),
    ],
)
def test_another_robot_is_named(monkeypatch, quantity, factor, named):
    write = PhysxEngine._write

    def write_wrong(engine, name, values, rows=None):
        write(engine, name, values * factor if name == quantity else values, rows)

    monkeypatch.setattr(PhysxEngine, "_write", write_wrong)
    env = build("physx")
    flying(env)
    advance(env, 24)
    assert env.scene.sim.robot_differences() == ([named] if named else [])


def test_a_wheel_counts_its_turns():
    env = build("physx")
    flying(env)
    env.scene.sim.expand("opt.gravity").zero_()
    robot = env.scene.robot
    wheels, _ = robot.find_joints([".*03"])
    robot.set_joint_velocity_target(torch.full((2, 2), 20.0), wheels)
    advance(env, 240)
    data = robot.data
    assert data.joint_pos[:, wheels].min() > 2.0 * 2.0 * math.pi
    before = data.joint_pos[:, wheels].clone()
    advance(env, 1)
    assert torch.allclose(data.joint_pos[:, wheels] - before, data.joint_vel[:, wheels] * DT, atol=1e-3)


def test_the_ground_carries_the_weight():
    env = build("physx")
    lift(env, 0.12)
    lifted = []
    for _ in range(360):
        advance(env, 1)
        lifted.append(env.scene["contact_forces"].data.net_forces_w.sum(dim=1)[:, 2])
    weight = env.scene.sim.expand("body_mass").sum(dim=1).float() * G
    assert torch.allclose(torch.stack(lifted[-60:]).mean(dim=0), weight, rtol=0.01)


def free(engine, *words):
    """Return an environment whose robots are at rest in the air, without gravity."""
    env = build(engine, *words)
    flying(env)
    env.scene.sim.expand("opt.gravity").zero_()
    robot = env.scene.robot
    robot.write_root_velocity_to_sim(torch.zeros(2, 6))
    robot.write_joint_state_to_sim(robot.data.default_joint_pos, 0.0 * robot.data.default_joint_vel)
    robot.set_joint_position_target(robot.data.default_joint_pos)
    robot.set_joint_velocity_target(0.0 * robot.data.default_joint_vel)
    env.scene.refresh()
    return env


@pytest.mark.parametrize("engine", ENGINES)
def test_a_drive_reaches_its_speed_by_the_time_constant_of_armature_over_damping(engine):
    drive = "env.robot.actuators.wheels."
    env = free(engine, f"{drive}armature=0.05", f"{drive}damping=0.5", f"{drive}effort_limit=10.0")
    robot = env.scene.robot
    wheels, _ = robot.find_joints([".*03"])
    robot.set_joint_velocity_target(torch.full((2, 2), 5.0), wheels)
    advance(env, 12)  # 0.1 s, one time constant
    speed = robot.data.joint_vel[:, wheels] / 5.0
    assert torch.allclose(speed, torch.tensor(1.0 - math.exp(-1.0)), rtol=0.03), speed


@pytest.mark.parametrize("engine", ENGINES)
def test_a_robot_lands_when_the_parabola_meets_the_ground(engine):
    env = build(engine)
    robot = env.scene.robot
    lift(env, 0.5)
    wheels, _ = robot.find_bodies([".*_wheel_link"])
    gap = float(robot.data.body_pos_w[:, wheels, 2].min()) - RADIUS
    steps = 0
    while not env.scene["contact_forces"].data.net_forces_w.any():
        advance(env, 1)
        steps += 1
    assert steps * DT == pytest.approx(math.sqrt(2.0 * gap / G), abs=1.5 * DT)


def test_a_robot_with_stiff_joints_topples_as_in_mujoco():
    keys, tilts = ("stiffness=50.0", "damping=0.5", "effort_limit=50.0"), []
    for engine in ENGINES:
        env = build(engine, *(f"env.robot.actuators.{group}.{key}" for group in ("legs", "wheels") for key in keys))
        robot, pitch = env.scene.robot, torch.tensor([0.01, -0.01])
        robot.set_joint_position_target(robot.data.default_joint_pos)
        lift(env, 0.07, torch.stack(((pitch / 2.0).cos(), 0.0 * pitch, (pitch / 2.0).sin(), 0.0 * pitch), dim=1))
        advance(env, 36)
        tilts.append(float(robot.data.projected_gravity_b[:, 0].asin().diff()))
    assert tilts[0] < -0.06  # the tilts differed by 0.02
    assert tilts[0] == pytest.approx(tilts[1], rel=0.1)


def _box(half, height):
    """Return USD text of a mesh: a box with square base, at a height."""
    points = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (height - half, height + half)]
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    indices = ", ".join(str(i) for face in faces for i in face)
    return f"""def Mesh "mesh"
    {{
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [{indices}]
        point3f[] points = {points}
        uniform token subdivisionScheme = "none"
    }}"""


# As the URDF importer of Isaac Sim writes it: the collider is a group, which contains the mesh, in an instance.
WITH_GROUP = f"""#usda 1.0
(
    defaultPrim = "wheelleg"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "collisions"
{{
    def Xform "group" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"])
    {{
        uniform token physics:approximation = "convexHull"
    {_box(0.03, 0.1)}
    }}
}}
def Xform "wheelleg" (references = @wheelleg/wheelleg.usda@)
{{
    over "wl2"
    {{
        over "base_link"
        {{
            over "collisions" (prepend references = </collisions>)
            {{
            }}
        }}
    }}
}}
"""


# As an older importer writes it: the instance itself is the collider.
COLLIDER = ' (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"])'
WITH_INSTANCE = WITH_GROUP.replace(COLLIDER, "").replace(
    'over "collisions" (', 'def Xform "more" (instanceable = true; prepend apiSchemas = ["PhysicsCollisionAPI"]; '
)


@pytest.mark.parametrize("text", [WITH_GROUP, WITH_INSTANCE])
def test_a_robot_rests_on_a_collider_above_meshes_in_an_instance(tmp_path, text):
    shutil.copytree(assets_dir() / "wheelleg", tmp_path / "wheelleg")
    (tmp_path / "robot.usda").write_text(text)
    heights = []
    for engine in ("mujoco", "physx"):
        words = ["task=stand", "robot=physical", "env.num_envs=1", f"env.sim.engine={engine}"]
        words += [f"env.robot.asset={tmp_path / 'robot.usda'}"]
        env = build_env(compose(words).config)
        lift(env, 0.14, torch.tensor([[0.0, 1.0, 0.0, 0.0]]))  # upside down: it falls by 1 cm
        advance(env, 60)
        heights.append(env.scene.robot.data.root_pos_w[0, 2].item())
    assert heights == pytest.approx([0.13, 0.13], abs=0.002)


def test_gravity_mass_and_force_of_an_environment_act_in_physx():
    env = build("physx", num_envs=4)
    flying(env)
    robot, sim = env.scene.robot, env.scene.sim
    down = torch.tensor([0.0, 0.0, -G], dtype=torch.float64)
    sim.expand("opt.gravity")[:] = down
    sim.expand("opt.gravity")[1] = 0.0
    masses = sim.expand("body_mass")
    masses[2] *= 2.0
    sim.expand("body_inertia")[2] *= 2.0
    sim.set_const()
    forces = torch.zeros(4, 1, 3)
    forces[2, 0, 2] = masses[2].sum() * G
    forces[3, 0, 2] = masses[3].sum() * G * 2.0
    robot.set_external_force_and_torque(forces, torch.zeros(4, 1, 3), body_ids=[0], is_global=True)

    def rising():
        mass = masses[:, robot.body_ids].float()
        return (robot.data.body_lin_vel_w[..., 2] * mass).sum(dim=1) / mass.sum(dim=1)

    start = rising()
    advance(env, 1)
    gained = (rising() - start) / (G * DT)
    assert torch.allclose(gained, torch.tensor([-1.0, 0.0, 0.0, 1.0]), atol=0.02)


@pytest.mark.parametrize("turns", [0.7, 1.5, -3.0])
def test_a_wheel_reaches_a_target_several_turns_away(turns):
    env = build("physx", "env.robot.actuators.wheels.stiffness=0.02", "env.robot.actuators.wheels.damping=0.004")
    flying(env)
    env.scene.sim.expand("opt.gravity").zero_()
    robot = env.scene.robot
    wheels, _ = robot.find_joints([".*03"])
    robot.set_joint_velocity_target(torch.zeros(2, 2), wheels)
    robot.set_joint_position_target(torch.full((2, 2), turns * 2.0 * math.pi), wheels)
    advance(env, 480)
    assert torch.allclose(robot.data.joint_pos[:, wheels], torch.tensor(turns * 2.0 * math.pi), atol=0.05)


def test_what_physx_cannot_simulate_is_refused():
    with pytest.raises(ConfigError, match=r"env\.robot\.base"):
        build("physx", "env.robot.base=fixed")
    with pytest.raises(ConfigError, match="jnt_stiffness"):
        build("physx").scene.sim.expand("jnt_stiffness")


def test_two_environments_do_not_touch():
    env = build("physx", "env.scene.env_spacing=0.0")
    env.scene.sim._start.zero_()  # Otherwise, PhysX simulates the two robots 0.5 m apart.
    flying(env)
    advance(env, 1)
    pose = env.scene.sim._read("ROOT_POSE")
    assert (pose[0, :3] - pose[1, :3]).norm() < 0.01
    assert env.scene["contact_forces"].data.net_forces_w.abs().max() == 0.0


def test_a_robot_drives_on_the_tiles_of_the_generator():
    env = build_env(compose(["task=terrain", "env.num_envs=4", "env.sim.engine=physx"]).config)
    env.reset()
    for _ in range(30):
        env.step(torch.zeros(4, 6))
    data = env.scene.robot.data
    height = data.root_pos_w[:, 2] - env.scene.terrain.height_at(data.root_pos_w[:, :2])
    assert ((height > 0.03) & (height < 0.12)).all()


@pytest.mark.parametrize(("engine", "deepest"), [("mujoco", 0.005), ("physx", 0.0005)])
def test_driven_wheels_do_not_sink_into_the_edge_of_a_step(engine, deepest):
    """The deepest penetration at these yaws and speeds is 3.9 mm with MuJoCo 4.0.1, and 0.14 mm with PhysX."""
    yaws, speeds = torch.deg2rad(torch.tensor([0.0, 3.0, 10.0, 20.0, 35.0, 50.0, 65.0])), torch.tensor([0.3, 0.6, 0.8])
    yaw, speed = torch.cartesian_prod(yaws, speeds).T
    ground, step, half = "env.scene.terrain.", 0.012, 0.5  # step height, half of the edge of a raised square, m
    words = ["scene=steps", *(f"{ground}num_{lines}=1" for lines in ("rows", "cols"))]
    words += [f"{ground}sub_terrains.{name}=null" for name in ("stairs", "stairs_inverted", "step_inverted")]
    words += [f"{ground}sub_terrains.step.box_height_range=[{step},{step}]"]
    words += [f"{ground}sub_terrains.step.platform_width={2 * half}", "env.sim.cone=elliptic", "env.sim.impratio=10"]
    env = build(engine, *words, num_envs=len(yaw))
    robot = env.scene.robot
    wheels, bodies = robot.find_joints([".*03"])[0], robot.find_bodies([".*_wheel_link"])[0]
    state = robot.data.default_root_state.clone()
    state[:, :2] = torch.tensor([-half - 0.12, 0.0])
    state[:, 3], state[:, 6] = (yaw / 2).cos(), (yaw / 2).sin()
    state[:, 7], state[:, 8] = speed * yaw.cos(), speed * yaw.sin()
    robot.write_root_state_to_sim(state)
    spins = torch.zeros_like(robot.data.default_joint_vel)
    spins[:, wheels] = (speed / RADIUS)[:, None]
    robot.write_joint_state_to_sim(robot.data.default_joint_pos, spins)
    robot.set_joint_position_target(robot.data.default_joint_pos)
    robot.set_joint_velocity_target(spins)
    env.scene.refresh()
    depth = torch.zeros(len(yaw))
    for _ in range(60):
        advance(env, 1)
        for body in bodies:
            axes = quat_apply(robot.data.body_quat_w[:, body], torch.tensor([[0.0, 1.0, 0.0]]).expand(len(yaw), 3))
            depth = depth.maximum(depth_in_step(robot.data.body_pos_w[:, body], axes, -half, step))
    assert 0.0 < float(depth.max()) < deepest


def test_the_manifest_states_that_a_restored_state_is_not_exact():
    promise = build("physx").scene.sim.promise()
    assert promise["name"] == "physx"
    assert promise["exact"] is False
    assert promise["version"].startswith("0.7.")
