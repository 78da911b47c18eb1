"""Compare a project's YAML with the known numbers of its robot."""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from env.composed import composed
from patience import thinned

from project.robots import BODY, HIGH, LEG, LOW, RADIUS, along_y, edited, four_legs, knees, urdf, with_hip_yaw
from wheelleg_exp.asset import convert
from wheelleg_exp.asset.robot_description import Drive
from wheelleg_exp.cli.main import main
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import AssetError
from wheelleg_exp.lint.physics_check import examine
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.project.create import config_files, create, write
from wheelleg_exp.project.robot_yaml import leg_gains, names, number, robot_yaml, spawn_height, wheel_gains
from wheelleg_exp.project.survey import survey

END = "</robot>"
TRUNK = '<box size="0.2 0.1 0.1"/>'


def stock_env():
    return composed("task=stand").config["env"]


def surveyed(source):
    return survey(source, stock_env(), {})


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    return surveyed(urdf(tmp_path_factory.mktemp("two")))


@pytest.fixture(scope="module")
def kneed(tmp_path_factory):
    path = knees(tmp_path_factory.mktemp("kneed"))
    return path, surveyed(path)


def test_wheels_are_the_unlimited_hinges_and_legs_are_the_remaining_hinges(two):
    assert (two.legs, two.wheels) == (["l_hip", "r_hip"], ["l_axle", "r_axle"])
    assert (two.wheel_bodies, two.raised_bodies) == (["l_wheel", "r_wheel"], ["body", "l_leg", "r_leg"])
    assert two.facts.wheel_radius == pytest.approx(RADIUS)


def test_a_hub_inside_its_tyre_does_not_touch_the_ground(tmp_path):
    hub = """
  <link name="l_hub"><inertial><mass value="0.01"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>
    </inertial><collision><origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="0.02" length="0.05"/>
    </geometry></collision></link>
  <joint name="l_rim" type="fixed"><parent link="l_wheel"/><child link="l_hub"/></joint></robot>"""
    found = surveyed(edited(urdf(tmp_path), (END, hub)))
    assert found.wheel_bodies == ["l_wheel", "r_wheel"]
    assert "l_hub" not in found.raised_bodies


def test_a_robot_without_wheels_gets_a_task_without_them(tmp_path):
    ankle = 'type="revolute"><limit lower="-1" upper="1" effort="8" velocity="20"/>'
    found = surveyed(edited(urdf(tmp_path), ('type="continuous">', ankle)))
    assert found.wheels == found.wheel_bodies == []
    assert found.legs == ["l_hip", "r_hip", "l_axle", "r_axle"]
    # The feet are missing in the list, because they stand on the ground.
    assert found.raised_bodies == ["body", "l_leg", "r_leg"]
    env = env_of(found, tmp_path)
    named = [*env["actions"], *env["rewards"], *env["observations"]["policy"]["terms"]]
    assert ("leg_pos" in named, [name for name in named if re.search("wheel|travel", name)]) == (True, [])


def test_a_robot_whose_legs_cannot_balance_it_leans(two):
    hip = LOW + 0.08 * (HIGH - LOW)  # The hip angle is as near to balance as the joint limits allow.
    assert two.positions == {"l_hip": pytest.approx(hip), "r_hip": pytest.approx(hip), "l_axle": 0.0, "r_axle": 0.0}
    assert two.standing.lean == pytest.approx(-hip, abs=1e-4)
    assert two.standing.frame == pytest.approx((math.cos(hip / 2), 0.0, math.sin(hip / 2), 0.0), abs=1e-4)
    assert (two.rotation, two.up) == ((1.0, 0.0, 0.0, 0.0), pytest.approx((0.0, 0.0, 1.0), abs=1e-4))


def test_a_robot_without_leg_joints_leans_so_that_its_mass_is_over_the_axle(tmp_path):
    changes = (
        ('type="revolute"', 'type="fixed"'),
        (f'<inertial><mass value="{BODY}"/>', f'<inertial><origin xyz="0.06 0 0"/><mass value="{BODY}"/>'),
    )
    found = surveyed(edited(urdf(tmp_path), *changes))
    # The body of 2 kg is 0.2 m above the axle, and the two legs of 0.3 kg are 0.1 m above it.
    ahead, above = 2 * 0.06 / 2.6, (2 * 0.2 + 0.6 * 0.1) / 2.6
    assert found.standing.lean == pytest.approx(-math.atan2(ahead, above), abs=1e-6)
    assert any("starts pitched by -15°" in note for note in found.notes)


LIGHT = '<inertial><mass value="0.05"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
CASTER = f"""<link name="fork">{LIGHT}</link>
  <joint name="swivel" type="continuous"><parent link="body"/><child link="fork"/>
    <origin xyz="-0.12 0 -0.2"/><axis xyz="0 0 1"/></joint>
  <link name="roller">{LIGHT}<collision><origin rpy="1.5707963267948966 0 0"/><geometry>
    <cylinder radius="0.02" length="0.01"/></geometry></collision></link>
  <joint name="roll" type="continuous"><parent link="fork"/><child link="roller"/><origin xyz="-0.02 0 0"/>
    <axis xyz="0 1 0"/></joint></robot>"""


def test_a_caster_stays_passive(tmp_path):
    found = surveyed(edited(urdf(tmp_path), (END, CASTER)))
    assert (found.legs, found.held, found.wheels) == (["l_hip", "r_hip"], [], ["l_axle", "r_axle"])
    assert (found.passive, found.anatomy.forward) == (["swivel", "roll"], (1.0, 0.0, 0.0))
    assert found.positions["swivel"] == found.positions["roll"] == 0.0
    driven = yaml.safe_load(robot_yaml("mine", "mine/two.urdf", found))["actuators"]
    assert [group["joint_names_expr"] for group in driven.values()] == [["l_hip", "r_hip"], ["l_axle", "r_axle"]]


@pytest.mark.parametrize(
    ("gains", "driven"),
    [
        ({"l_axle": (0.0, 1.0), "swivel": (0.0, 0.0)}, ("l_axle",)),
        ({"l_axle": (0.0, 0.0), "r_axle": (0.0, 0.0)}, ("l_axle", "r_axle")),
        ({}, ()),
    ],
)
def test_a_drive_without_gains_is_a_motor_only_if_no_drive_has_gains(gains, driven, tmp_path):
    robot = convert(edited(urdf(tmp_path), (END, CASTER)), tmp_path / "robot.xml").description
    drives = {name: Drive("force", stiffness, damping, None) for name, (stiffness, damping) in gains.items()}
    bodies = [replace(b, dofs=tuple(replace(d, drive=drives.get(d.name)) for d in b.dofs)) for b in robot.bodies]
    assert replace(robot, bodies=tuple(bodies)).driven == driven


L_HIP, FAR = '<joint name="l_hip" type="revolute">', '<mimic joint="r_hip" multiplier="0" offset="5"/>'
DEEP = f"""<robot name="two"><link name="deep">{LIGHT}</link>
  <joint name="up" type="fixed"><parent link="deep"/><child link="body"/><origin xyz="0 0 1"/></joint>"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('<robot name="two">', DEEP, "the root link 'deep' is below the ground"),
        (L_HIP, f"{L_HIP}{FAR}", "a coupling moves joint 'l_hip' to 5, beyond its limits"),
        (f'radius="{RADIUS}"', 'radius="100"', "3 kg in 200 m"),
        ('type="continuous">', 'type="floating">', "file/two.urdf: the file contains 3 robots"),
    ],
    ids=["root below the ground", "coupling", "size", "three robots"],
)
def test_a_robot_that_cannot_start_makes_no_project(old, new, said, tmp_path):
    source = edited(urdf(tmp_path / "file"), (old, new))
    with pytest.raises(AssetError, match=re.escape(said)):
        create(tmp_path / "mine", source)
    assert not (tmp_path / "mine").exists()


LIMITED = 'type="revolute"><limit lower="-3.1416" upper="3.1416" effort="8" velocity="20"/>'
WHEEL = '<collision><origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="0.06" length="0.02"/></geometry>'


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([('type="continuous">', LIMITED)], "'l_axle' would be a wheel, but its limits of -3.142 to 3.142 rad"),
        ([('type="continuous">', 'type="fixed">')], "'l_wheel' would be a wheel, but it is fixed"),
        ([(f"{WHEEL}\n    </collision>", "")], "'l_axle' would be a wheel, but nothing of what it turns collides"),
        ([('"l_axle" type="continuous">', f'"l_axle" {LIMITED}')], "'l_axle' would be a wheel, but its limits"),
        ([(' xyz="0 0.08 0"', ' xyz="0 0 0"'), ("r_leg", "gone")], "one wheel, 'l_axle', and falls sideways"),
    ],
    ids=["limits", "fixed", "no collider", "one side", "one leg"],
)  # fmt: skip
def test_a_robot_that_cannot_roll_makes_no_project_unless_allowed(changes, said, tmp_path):
    source = urdf(tmp_path)
    if "one wheel" in said:
        text = source.read_text()
        source.write_text(text[: text.index('<link name="r_leg">')] + END)
        changes = changes[:1]
    edited(source, *changes)
    with pytest.raises(AssetError, match=re.escape(said)) as refused:
        surveyed(source)
    assert "--allow-missing" in refused.value.expected
    assert survey(source, stock_env(), {}, allow_missing=True).legs


def test_a_robot_starts_so_high_that_no_tilt_of_a_start_state_puts_a_wheel_into_the_ground(two):
    touching = LEG + RADIUS
    assert two.facts.standing_height == pytest.approx(touching, abs=1e-6)
    half = 0.08  # lateral distance of the hips from the middle in robots.py, m
    tilt = compose(["task=stand"]).config["env"]["events"]["reset_base"]["pose_range"]["roll"][1]
    assert 0.0 <= spawn_height(two) - touching - half * tilt < 1.0001e-4


def test_a_robot_drawn_along_another_axis_stands_like_the_one_along_x(two, tmp_path):
    turned = surveyed(along_y(urdf(tmp_path)))
    assert turned.positions == pytest.approx(two.positions, abs=1e-3)
    assert turned.facts.standing_height == pytest.approx(two.facts.standing_height, abs=1e-4)
    for mine, theirs in ((leg_gains(turned), leg_gains(two)), (wheel_gains(turned), wheel_gains(two))):
        assert mine.stiffness == pytest.approx(theirs.stiffness, rel=0.02)
        assert mine.damping == pytest.approx(theirs.damping, rel=0.02)
    quarter, lean = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)), two.standing.frame
    product = (quarter[0] * lean[0], -quarter[3] * lean[2], quarter[0] * lean[2], quarter[3] * lean[0])
    # The quaternion is the product of the yaw by 90 degrees and the lean.
    assert turned.standing.frame == pytest.approx(product, abs=1e-3)


def posed(path, positions):
    """Pose the robot with MuJoCo's own URDF reader, which welds the base to the world."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for name, value in positions.items():
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    return model, data


def test_a_leg_of_two_joints_brings_the_mass_over_the_axle(kneed):
    path, found = kneed
    assert (found.standing.lean, found.standing.frame) == (0.0, None)
    model, data = posed(path, found.positions)
    mass = BODY + model.body_mass.sum()  # The mass of the base is missing, because the base is a part of the world.
    assert mass == pytest.approx(found.facts.mass)
    assert (model.body_mass @ data.xipos / mass)[0] == pytest.approx(data.joint("l_axle").xanchor[0], abs=2e-3)
    assert found.positions["l_hip"] == found.positions["r_hip"]
    assert abs(found.positions["l_knee"]) > 0.2  # The knees are bent, because stretched legs cannot absorb shocks.


def wheel_centres(path, positions) -> np.ndarray:
    """Return the centres of the wheels, m, (wheels, 3)."""
    _, data = posed(path, positions)
    return np.array([data.joint(name).xanchor for name in positions if name.endswith("_axle")])


@pytest.mark.parametrize("limits", ['<limit lower="-0.7" upper="0.7" effort="8" velocity="20"/>', ""])
def test_hips_that_yaw_without_limits_do_not_make_casters_of_the_wheels(limits, tmp_path):
    path = with_hip_yaw(tmp_path, limits)
    found = surveyed(path)
    assert found.anatomy.forward == (1, 0, 0)
    assert (found.standing.frame, found.facts.track) == (None, pytest.approx(0.16, abs=1e-3))
    assert abs(found.positions["l_yaw"]) < 0.02
    assert abs(found.positions["l_knee"]) > 0.2  # The pose was solved, so the knee is not at 0.
    left, right = wheel_centres(path, found.positions)
    assert left - right == pytest.approx((0, 0.16, 0), abs=1e-3)
    assert not [note for note in found.notes if "parallel" in note]


def test_a_wheel_with_written_limits_stays_a_wheel(tmp_path):
    limited = ('type="continuous">', 'type="continuous"><limit lower="-1" upper="1"/>')
    assert surveyed(edited(urdf(tmp_path), limited)).wheels == ["l_axle", "r_axle"]


@pytest.mark.parametrize("front", thinned([0.26, 0.14], 2))
def test_all_four_wheels_touch_the_ground(front, tmp_path):
    path = four_legs(tmp_path, front)
    found = surveyed(path)
    assert np.ptp(wheel_centres(path, found.positions)[:, 2]) < 1e-3
    assert len(found.anatomy.standing) == 4
    assert not [note for note in found.notes if "touch the ground" in note]


def test_wheels_that_cannot_reach_the_ground_are_named(tmp_path):
    nose = """
  <link name="nose"><inertial><mass value="0.01"/><inertia ixx="2e-6" iyy="4e-6" izz="2e-6" ixy="0" ixz="0" iyz="0"/>
    </inertial><collision><origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="0.02" length="0.01"/>
    </geometry></collision></link>
  <joint name="nose_axle" type="continuous"><parent link="body"/><child link="nose"/><origin xyz="0.2 0 -0.08"/>
    <axis xyz="0 1 0"/></joint></robot>"""
    tall = '<origin xyz="0 0 0.2"/><geometry><box size="0.2 0.1 0.5"/>'
    changes = ((END, nose), (f"<geometry>{TRUNK}", tall), (f'upper="{HIGH}"', 'upper="0.5"'))
    found = surveyed(edited(urdf(tmp_path), *changes))
    assert [wheel.joint for wheel in found.anatomy.standing] == ["l_axle", "r_axle"]
    assert "only 2 of 3 wheels touch the ground in the default pose, not those of nose_axle" in found.notes


def env_of(found, folder):
    texts = {"robot/mine.yaml": robot_yaml("mine", "mine/two.urdf", found), **config_files("mine", found)}
    write(folder / "made" / "configs", texts)
    return compose(["task=mine"], config_dirs=[folder / "made" / "configs"]).config["env"]


@pytest.mark.parametrize("mass", [0, 1e-6], ids=["none", "next to none"])
def test_a_root_link_without_mass_on_the_ground_changes_nothing(mass, kneed, tmp_path):
    inertial = LIGHT.replace("0.05", str(mass)).replace("1e-4", "1e-9")
    foot = """<link name="base_footprint">{}</link><joint name="foot" type="fixed"><parent link="base_footprint"/>
      <child link="body"/><origin xyz="0 0 0.51"/></joint><link name="body">"""
    foot = foot.format(inertial if mass else "")
    found, (_, expected) = surveyed(edited(knees(tmp_path), ('<link name="body">', foot))), kneed
    assert found.facts.standing_height == pytest.approx(expected.facts.standing_height, abs=5e-4)
    folders = (tmp_path / "one", tmp_path / "other")
    reward, plain = (env_of(r, f)["rewards"]["base_height"] for r, f in zip((found, expected), folders, strict=True))
    # The height is the distance from axle to hip plus the wheel radius.
    robot = yaml.safe_load(robot_yaml("mine", "mine/knees.urdf", found))
    assert robot["standing_height"] == pytest.approx(0.3815, abs=1e-3)
    assert reward == plain


def test_an_overlap_of_the_default_pose_is_not_simulated(tmp_path):
    found = surveyed(edited(urdf(tmp_path), (TRUNK, '<box size="0.2 0.3 0.3"/>')))
    assert {"body", "l_wheel"} in map(set, found.overlaps)
    assert yaml.safe_load(robot_yaml("mine", "mine/two.urdf", found))["self_collisions"] is False


def test_limits_are_the_files_and_missing_gains_follow_from_inertias(two):
    gains = leg_gains(two)
    assert (gains.effort, gains.velocity) == ({"l_hip": 8.0, "r_hip": 8.0}, {"l_hip": 20.0, "r_hip": 20.0})
    assert gains.given == ["effort", "velocity"]
    joint = two.facts.joints["l_hip"]
    kp, kd = gains.stiffness["l_hip"], gains.damping["l_hip"]
    assert kp >= 0.95 * abs(joint.hold) / 0.05  # The weight bends the joint by at most 0.05 rad, except for rounding.
    assert kd / (2 * math.sqrt(kp * joint.effective)) == pytest.approx(0.7, rel=0.1)


@pytest.mark.parametrize(("strength", "steps"), [(1.9, 4), (2.9, 6), (5.5, 11)])
def test_strong_damping_of_the_legs_shortens_the_physics_steps(strength, steps, two):
    inertia = two.facts.joints["l_hip"].effective
    drive = Drive("force", 20.0, strength * inertia / 0.005, None)  # kd·dt/I = strength with steps of 5 ms
    dofs = {name: replace(dof, drive=drive) if name in two.legs else dof for name, dof in two.dofs.items()}
    made = yaml.safe_load(robot_yaml("mine", "mine/two.urdf", replace(two, dofs=dofs)))
    assert (made["decimation"], made["physics_dt"]) == (steps, pytest.approx(0.02 / steps))


def test_wheels_follow_speeds_and_are_about_as_strong_as_their_traction(two):
    gains = wheel_gains(two)
    assert set(gains.stiffness.values()) == {0.0}
    slip = two.facts.friction * two.facts.weight / 2 * RADIUS
    assert (gains.effort["l_axle"], gains.given) == (pytest.approx(1.5 * slip, rel=0.1), [])


def test_gains_of_drives_in_the_file_are_used():
    stock = stock_env()["robot"]
    found = survey(assets_dir() / stock["asset"], stock_env(), stock["init_state"]["joint_pos"])
    text = yaml.safe_load(robot_yaml("mine", "mine/wheelleg.usda", found))
    for group in ("legs", "wheels"):
        for key in ("stiffness", "damping", "effort_limit", "velocity_limit"):
            assert text["actuators"][group][key] == pytest.approx(stock["actuators"][group][key]), key
    assert text["init_state"]["joint_pos"] == {"l01": 0.9599, "r01": 0.9599, "l02": -1.885, "r02": -1.885}
    # docs/robot.md states a standing height of 70 mm, and a distance of 112 mm between the wheels.
    assert text["init_state"]["pos"][2] == pytest.approx(0.070 + 0.03 * 0.056, abs=2e-4)


@pytest.mark.parametrize(("without", "said"), [("joint", "no joints"), ("collision", "no shape of the robot collides")])
def test_a_robot_that_cannot_stand_is_refused(without, said, tmp_path):
    path = urdf(tmp_path)
    text = re.sub(rf"<{without}\b.*?</{without}>", "", path.read_text(), flags=re.DOTALL)
    if without == "joint":  # A robot has one root link, so only one link remains.
        text = text[: text.index('<link name="l_leg"')] + "</robot>"
    path.write_text(text)
    with pytest.raises(AssetError, match=said):
        surveyed(path)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.25, "0.25"), (1.0, "1.0"), (-5100, "-5100.0"), (1e-5, "1.0e-05"), (2.5e-7, "2.5e-07"), (0, "0.0")],
)
def test_numbers_are_floats_to_yaml(value, text):
    assert (number(value), yaml.safe_load(f"[{text}]")) == (text, [pytest.approx(value)])


def test_odd_names_survive_yaml_and_match_themselves_alone():
    odd = ["a.b", "on", "knee:L", "hip (left)", "x[1]", "-", "1", "plain_name"]
    for name, read in zip(odd, yaml.safe_load(names(odd, 4)), strict=True):
        assert [other for other in [*odd, "aXb"] if re.fullmatch(read, other)] == [name]


def examined(made, *overrides):
    return examine(compose(["task=mine", *overrides], config_dirs=[made.path / "configs"]))


WEAK = ("0.01 N·m on wheels of 60 mm", "0.7 rad/s on wheels of 60 mm is 0.042 m/s")


# Rounding increases the velocity of the second robot.
@pytest.mark.parametrize(("limits", "said"), [((0.01, 0.7), WEAK), ((0.6, 7.46), ())], ids=["weak", "strong"])
def test_a_project_of_a_robot_with_limited_wheels_passes_its_own_check(limits, said, tmp_path):
    limit = 'effort="{}" velocity="{}"'.format(*limits)
    source = edited(knees(tmp_path / "file"), ('type="continuous">', f'type="continuous"><limit {limit}/>'))
    made = create(tmp_path / "mine", source)
    assert examined(made).open == []
    assert ("weak_wheels" in made.accepted) == bool(said)
    assert [part for part in said if part not in made.accepted["weak_wheels"]] == []


def test_the_stock_robots_file_makes_a_project_that_passes_its_own_check(tmp_path):
    made = create(tmp_path / "mine", assets_dir() / "wheelleg" / "wheelleg.usda")
    assert examined(made).open == []
    assert "9.25 rad/s" in made.accepted["drive_bandwidth"]
    env = compose(["task=mine"], config_dirs=[made.path / "configs"]).config["env"]
    stock = compose(["task=stand"]).config["env"]
    # The new robot is the stock robot, so its numbers are those of the stock task.
    weights = {name: node["weight"] for name, node in env["rewards"].items() if name != "mine_upright"}
    assert weights == pytest.approx({name: node["weight"] for name, node in stock["rewards"].items()}, rel=5e-3)
    limit = stock["commands"]["base_velocity"]["max_travel_error"]
    assert env["commands"]["base_velocity"]["max_travel_error"] == pytest.approx(limit, rel=2e-3)


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"


def with_lost_meshes(folder: Path, content: str | None) -> Path:
    path = edited(knees(folder), ('<cylinder radius="0.06" length="0.02"/>', '<mesh filename="wheel.stl"/>'))
    if content is not None:
        (folder / "wheel.stl").write_text(content)
    return path


def test_wheels_whose_meshes_are_missing_make_no_project_unless_allowed(tmp_path, capsys):
    for content, why in ((None, "the file is missing"), (POINTER, "git lfs pull")):
        source = with_lost_meshes(tmp_path / "file", content)
        with pytest.raises(AssetError, match=r"colliders are missing: wheel\.stl") as refused:
            create(tmp_path / "mine", source)
        assert why in refused.value.message
        assert "'l_axle', 'r_axle' turn without limits as wheels do" in refused.value.message
        assert "--allow-missing" in refused.value.expected
        assert not (tmp_path / "mine").exists()
    made = create(tmp_path / "mine", source, allow_missing=True)
    assert refused.value.message in made.robot.notes
    for _ in range(2):  # The second run reads the robot from the cache.
        assert [finding.message for finding in examined(made).open] == [refused.value.message]
    assert main(["doctor", str(source), "--json"]) == 1
    assert refused.value.message in capsys.readouterr().out


def test_a_robot_that_lost_all_its_meshes_is_refused_with_their_names(tmp_path):
    source = with_lost_meshes(tmp_path, None)
    source.write_text(re.sub(r'<box size="[^"]*"/>', '<mesh filename="body.stl"/>', source.read_text()))
    with pytest.raises(AssetError, match=r"body\.stl.*'l_axle', 'r_axle' turn without limits"):
        surveyed(source)
    with pytest.raises(AssetError, match="no shape of the robot collides"):
        survey(source, stock_env(), {}, allow_missing=True)


@pytest.mark.parametrize("arc", ["payload", "references"])
def test_wheels_whose_layer_is_missing_make_no_project(arc, tmp_path):
    stock = assets_dir() / "wheelleg"
    shutil.copytree(stock, tmp_path / "robot")
    bare = f'(prepend {arc} = @gone.usda@)\n{{\n over "collisions" (active = false)\n {{\n }}\n}}\n'
    wheels = "".join(f'over "{side}_wheel_link" {bare}' for side in "lr")
    source = tmp_path / "robot" / "bare.usda"
    source.write_text(
        '#usda 1.0\n(\n defaultPrim = "wheelleg"\n subLayers = [@wheelleg.usda@]\n)\n'
        f'over "wheelleg"\n{{\nover "wl2"\n{{\n{wheels}}}\n}}\n'
    )
    with pytest.raises(AssetError, match=r"colliders are missing: gone\.usda") as refused:
        create(tmp_path / "mine", source)
    assert "'l03', 'r03' turn without limits" in refused.value.message


def test_a_finding_that_only_the_file_can_solve_is_accepted_by_name(tmp_path):
    source = edited(urdf(tmp_path / "file"), ('_hip" type="revolute', '_hip" type="continuous'))
    made = create(tmp_path / "mine", source)
    assert "joint_limits" in made.accepted
    report = examined(made)
    assert report.open == []
    assert "l_hip" in report.reasons["joint_limits"]
    # The rule also checks user-defined numbers.
    assert "action_scale" in {finding.rule for finding in examined(made, "env.robot.action_scales.legs=50").open}


def test_an_effort_that_cannot_hold_the_weight_is_not_used(tmp_path):
    changes = (('effort="8"', 'effort="0.001"'), ('xyz="0 0 -0.1"', 'xyz="0.1 0 -0.1"'))
    gains = leg_gains(surveyed(edited(urdf(tmp_path), *changes)))
    assert min(gains.effort.values()) > 1.0
    assert any("does not hold the weight at l_hip" in reason for reason in gains.refused)


def test_joints_that_do_not_belong_to_a_leg_are_held_and_no_action_moves_them(tmp_path):
    turret = """
  <link name="turret"><inertial><origin xyz="0 0 0.05"/><mass value="0.3"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turret_yaw" type="revolute"><parent link="body"/><child link="turret"/><origin xyz="0 0 0.05"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="3" velocity="5"/></joint></robot>"""
    found = surveyed(edited(urdf(tmp_path), (END, turret)))
    assert (found.legs, found.held) == (["l_hip", "r_hip"], ["turret_yaw"])
    assert yaml.safe_load(robot_yaml("mine", "mine/two.urdf", found))["actuators"]["held"]["effort_limit"] == 3.0
    assert not [file for file, text in config_files("mine", found).items() if "turret_yaw" in text]
