import math
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from asset.small_usd import cube_inside, hinge, link, write
from project.robots import edited, knees

from lint.bodies import leg, mjcf, two_legged
from lint.cases import found, joints, term
from lint.patients import HEALTHY, HIP, KNEE, LINK, all_findings, case_of, patient, seeded
from wheelleg_exp.anatomy.collider_shapes import find_overlaps
from wheelleg_exp.anatomy.compiled_robot import Drive
from wheelleg_exp.anatomy.stance import balanced_pose, weight_over_axle
from wheelleg_exp.lint.diagnosis import _drives_of_mjcf, diagnose_file, notes_on
from wheelleg_exp.paths import assets_dir

TRUNK = '<inertial pos="0 0 0" mass="4" diaginertia="0.02 0.06 0.07"/>'
RIGHT = HEALTHY[HEALTHY.index('<body name="r_thigh"') : HEALTHY.index("</worldbody>")]
SHANK = next(line for line in RIGHT.splitlines() if 'name="r_shank" type' in line)
BENDS = '<position joint="r_knee" kp="200" kv="5" forcerange="-30 30"/>'
ROLLS = '<velocity joint="r_axle" kv="0.5" forcerange="-5 5"/>'
CYLINDER = 'type="cylinder" size="0.1 0.02" euler="1.5707963267948966 0 0"'


def only(rule: str, case) -> str:
    """Return the message of the only finding of a robot."""
    (finding,) = found(rule, case)
    assert [other.rule for other in all_findings(case)] == [rule]
    return f"{finding.message} | {finding.hint}"


def test_a_shifted_mass(tmp_path):
    case = patient(tmp_path, seeded((TRUNK, TRUNK.replace("0 0 0", "0.15 0 0"))))
    said = only("balance_pose", case)
    # The trunk is 4 kg of 4.4 kg, 0.15 m ahead. Each thigh and each shank has 0.1 kg.
    height = 2 * LINK * math.cos(HIP)
    thigh, shank = -0.15 * math.sin(HIP), -0.3 * math.sin(HIP) + 0.1 * math.sin(HIP)
    ahead = (4 * 0.15 + 0.2 * thigh + 0.2 * shank) / 4.4
    above = (4 * height + 0.2 * (height - 0.15 * math.cos(HIP)) + 0.2 * (0.2 * math.cos(HIP))) / 4.4
    assert f"{1e3 * ahead:.3g} mm in front" in said
    assert f"{math.degrees(math.atan2(ahead, above)):.2g}°" in said
    # The pose in the hint moves the weight above the axle.
    pose = dict(re.findall(r"(\w+): (-?[\d.]+)", said.split("|")[1]))
    keys = {"l": pose, "r": pose}
    key = " ".join(f"{keys[s][f'{s}_hip']} {keys[s][f'{s}_knee']} 0" for s in "lr")
    moved = seeded((TRUNK, TRUNK.replace("0 0 0", "0.15 0 0")), (f"{HIP} {KNEE} 0 {HIP} {KNEE} 0", key))
    model = mujoco.MjModel.from_xml_string(moved)
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0]
    mujoco.mj_forward(model, data)
    upper = [model.body(n).id for n in ("trunk", "l_thigh", "l_shank", "r_thigh", "r_shank")]
    x = model.body_mass[upper] @ data.xipos[upper][:, 0] / model.body_mass[upper].sum()
    assert x == pytest.approx(data.body("l_wheel").xpos[0], abs=1e-3)
    assert data.body("l_wheel").xpos[2] > 1 - height  # The robot stands lower, because the hint avoids stretched legs.


def test_the_healthy_robot_has_no_findings_and_its_weight_is_over_its_axle(tmp_path):
    robot = patient(tmp_path).robot
    assert all_findings(patient(tmp_path)) == []
    assert abs(weight_over_axle(robot).lean) < 0.02
    assert set(balanced_pose(robot)) == {"l_hip", "r_hip", "l_knee", "r_knee"}


def test_a_mass_outside_the_wheels_of_a_car(tmp_path):
    wheel = f'<inertial pos="0 0 0" mass="0.5" diaginertia="0.002 0.003 0.002"/><geom {CYLINDER}/>'
    body = '<body name="w{x}{y}" pos="{x} {y} 0"><joint name="j{x}{y}" axis="0 1 0"/>{wheel}</body>'
    wheels = "".join(body.format(x=x, y=y, wheel=wheel) for x in (0.15, -0.15) for y in (0.2, -0.2))
    text = (
        '<mujoco><compiler angle="radian"/><worldbody><body name="car" pos="0 0 1"><freejoint/>'
        '<inertial pos="0.19 0 0" mass="4" diaginertia="0.02 0.06 0.07"/><geom type="box" size="0.2 0.1 0.05"/>'
        f"{wheels}</body></worldbody></mujoco>"
    )
    assert "40 mm outside the outermost wheels, which are 300 mm apart" in only("balance_pose", patient(tmp_path, text))


def test_wheels_that_roll_along_y(tmp_path):
    text = HEALTHY.replace('axis="0 1 0"', 'axis="1 0 0"').replace('pos="0 0.2 0"', 'pos="0.3 0 0"')
    text = text.replace('pos="0 -0.2 0"', 'pos="-0.3 0 0"').replace("1.5707963267948966 0 0", "0 1.5707963267948966 0")
    text = text.replace('diaginertia="0.002 0.003 0.002"', 'diaginertia="0.003 0.002 0.002"')
    assert "roll along (0, 1) of the base 'trunk'" in only("rolling_direction", patient(tmp_path, text))


def test_steered_wheels_that_do_not_roll_one_way(tmp_path):
    text = HEALTHY
    for side, angle in (("l", 0.0), ("r", 1.5)):
        wheel = f'<body name="{side}_wheel" pos="0 0 -0.3">'
        pitch = f"{math.cos(0.2)} 0 {math.sin(0.2)} 0"  # The shank has a pitch of -0.4 rad, the sum of hip and knee.
        fork = f'<body name="{side}_fork" pos="0 0 -0.3" quat="{pitch}"><joint name="{side}_steer" axis="0 0 1"/>'
        fork += '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/>'
        text = text.replace(wheel, f'{fork}<body name="{side}_wheel" euler="0 0 {angle}">')
    text = text.replace("</body>\n        </body>\n      </body>", "</body></body>\n        </body>\n      </body>")
    text = text.replace(f"{HIP} {KNEE} 0 {HIP} {KNEE} 0", f"{HIP} {KNEE} 0 0 {HIP} {KNEE} 0 0")
    said = only("rolling_direction", patient(tmp_path, text))
    assert "the wheels of 'l_axle', 'r_axle' are steered" in said
    assert "cross" not in said


def test_wheels_that_toe_in(tmp_path):
    c, s = math.cos(0.1), math.sin(0.1)
    text = seeded(('name="l_axle" axis="0 1 0"', f'name="l_axle" axis="{s} {c} 0"'))
    text = text.replace('name="r_axle" axis="0 1 0"', f'name="r_axle" axis="{-s} {c} 0"')
    for side, turn in (("l", -0.1), ("r", 0.1)):
        straight = f'name="{side}_wheel" {CYLINDER}'
        assert straight in text
        zaxis = f"{-math.sin(turn)} {math.cos(turn)} 0"
        text = text.replace(straight, f'name="{side}_wheel" type="cylinder" size="0.1 0.02" zaxis="{zaxis}"')
    toe = math.degrees(math.asin(s * math.cos(HIP + KNEE)))  # The pitch of the wheel's link is the sum of hip and knee.
    assert f"turned by {toe:.2g}°" in only("rolling_direction", patient(tmp_path, text))


def test_a_flipped_wheel(tmp_path):
    text = seeded(('name="r_axle" axis="0 1 0"', 'name="r_axle" axis="0 -1 0"'))
    said = only("wheel_senses", patient(tmp_path, text))
    assert "'l_axle' rolls the robot forwards, of 'r_axle' backwards" in said
    wheels = term("actions.JointVelocityAction", joint_names=["._axle"], scale={"l_axle": 5.0, "r_axle": -5.0})
    assert found("wheel_senses", patient(tmp_path, text, actions={"wheels": wheels})) == []
    legs = term("actions.JointPositionAction", joint_names=[".*_hip"], scale={".*_hip": 0.5})
    assert "'l_axle' rolls" in only("wheel_senses", patient(tmp_path, text, actions={"legs": legs}))


def test_a_file_with_reversed_axes_on_one_whole_side_has_no_findings(tmp_path):
    turned = RIGHT.replace('axis="0 1 0"', 'axis="0 -1 0"').replace('range="-2 0"', 'range="0 2"')
    text = seeded((RIGHT, turned), (f"{HIP} {KNEE} 0 {HIP} {KNEE} 0", f"{HIP} {KNEE} 0 {-HIP} {-KNEE} 0"))
    assert all_findings(patient(tmp_path, text)) == []
    legs = term("actions.JointPositionAction", joint_names=[".*_hip"], scale={".*_hip": 0.5})
    assert found("wheel_senses", patient(tmp_path, text, actions={"legs": legs})) == []


PACK = """<body name="pack" pos="0 0.2 0"><joint name="lid" axis="0 0 1" range="-1 1"/>
  <geom name="pack" type="sphere" size="0.03" pos="{x} 0 {z}" mass="0.01"/></body>
      <body name="l_thigh\""""


def pack(into: float) -> str:
    """Return the robot with a ball next to the left thigh that overlaps the thigh by ``into`` m."""
    away = 0.03 + 0.02 - into  # The distance is measured from the thigh's axis.
    middle = np.array([-0.15 * math.sin(HIP), -0.15 * math.cos(HIP)])
    x, z = middle + away * np.array([math.cos(HIP), -math.sin(HIP)])
    return seeded(('<body name="l_thigh"', PACK.format(x=x, z=z)), ("0 0 1 1 0 0 0 ", "0 0 1 1 0 0 0 0 "))


def test_a_link_sunk_into_another(tmp_path):
    case = patient(tmp_path, pack(0.012))
    said = only("overlapping_bodies", case)
    assert "'pack' and 'l_thigh' by 12 mm" in said
    robot = case.robot
    (pair,) = [pair for pair in find_overlaps(robot.model, robot.data.qpos, robot.bodies) if not pair.neighbours]
    assert pair.depth == pytest.approx(0.012, abs=1e-6)
    assert all_findings(patient(tmp_path, pack(-0.001))) == []


def test_links_that_may_not_touch_are_only_noted(tmp_path):
    text = pack(0.012).replace('name="pack" type', 'name="pack" contype="0" type')
    case = patient(tmp_path, text.replace('name="l_thigh" type', 'name="l_thigh" contype="0" type'))
    assert all_findings(case) == []
    assert any("self_collisions: true would start with 1 pair" in note and "12 mm" in note for note in notes_on(case))


def test_a_link_deep_inside_its_parent(tmp_path):
    text = seeded(('name="l_thigh" type="capsule" fromto="0 0 -0.05 0 0 -0.25" size="0.02" mass="0.1"',
                   'name="l_thigh" type="sphere" size="0.25" pos="0 -0.2 0" mass="0.1"'))  # fmt: skip
    told = found("overlapping_bodies", patient(tmp_path, text))
    (finding,) = [finding for finding in told if "'l_thigh' is" in finding.message]
    assert finding.figures["depth_m"] == pytest.approx(0.25 + 0.05)


def test_a_cut_effort(tmp_path):
    said = only("effort_against_load", patient(tmp_path, seeded((BENDS, BENDS.replace("30", "3")))))
    # The knee carries half the robot's weight minus the wheel and half of the shank, at the lever of the shank.
    weight = (4 + 2 * 0.7) / 2 * 9.81
    hold = (weight - 0.5 * 9.81) * LINK * math.sin(HIP) - 0.1 * 9.81 * 0.1 * math.sin(HIP)
    assert f"3 N·m on 'r_knee', which carries {hold:.3g} N·m" in said


def test_wheels_slower_than_the_fall_that_they_have_to_catch(tmp_path):
    case = patient(tmp_path)
    needed = 0.1 * case.facts.balance.pole * case.facts.balance.height / case.facts.wheel_radius
    joints = case.facts.joints
    for speed, count in ((0.99 * needed, 1), (1.01 * needed, 0)):
        drive = Drive("wheels", 0.0, 0.5, 5.0, speed)
        wheels = {name: replace(joints[name], drive=drive) for name in case.facts.wheels}
        slow = replace(case, facts=replace(case.facts, joints={**joints, **wheels}))
        assert len(found("weak_wheels", slow)) == count


def test_a_square_wheel(tmp_path):
    text = seeded((CYLINDER, 'type="box" size="0.1 0.02 0.1"'))
    text = text.replace('size="0.1 0.02" euler', 'size="0.1414 0.02" euler')
    said = only("wheels_that_do_not_roll", patient(tmp_path, text))
    assert re.search(r"between 10\d.* and 141.4 mm", said)


def test_wheels_within_limits(tmp_path):
    text = HEALTHY.replace('_axle" axis="0 1 0"', '_axle" axis="0 1 0" range="-3.14 3.14"')
    messages = [finding.message.split(",")[0] for finding in found("wheels_that_do_not_roll", patient(tmp_path, text))]
    assert messages == [f"'{side}_axle' would be a wheel" for side in "lr"]


@pytest.mark.parametrize(
    ("rule", "part", "old", "new", "said"),
    [
        ("mirror_images", RIGHT, 'pos="0 -0.2 0"', 'pos="0.02 -0.2 0"', "20 mm and 0° off; nor are 2 more pairs"),
        ("mirror_images", SHANK, 'mass="0.1"', 'mass="0.2"', "'l_shank' weighs 0.1 kg and 'r_shank' 0.2 kg"),
        ("mirror_images", RIGHT, "0 0 -0.05 0 0 -0.25", "0 0.02 -0.01 0 0.02 -0.21", "44.7 mm off"),
        ("mirror_images", RIGHT, 'range="-1 1"', 'range="-1 1.5"', "0.5 off"),
        ("wheels_that_do_not_roll", RIGHT, 'size="0.1 0.02"', 'size="0.09 0.02"', "have radii of 100 and 90 mm"),
        ("weak_wheels", ROLLS, "5 5", "0.2 0.2", "0.2 N·m on wheels of 100 mm"),
        ("gains_against_time_step", BENDS, "200", "2e6", "'r_knee'"),
        ("joint_limits", HEALTHY, ' range="-2 0"', "", "'l_knee', 'r_knee' have no limits"),
        ("joint_limits", HEALTHY, 'range="-1 1"', 'range="0.4 0.4001"', "'l_hip', 'r_hip' allow no motion"),
    ],
)
def test_a_defect_is_the_only_finding(rule, part, old, new, said, tmp_path):
    assert old in part
    assert said in only(rule, patient(tmp_path, seeded((part, part.replace(old, new)))))


SIDE = """<link name="{s}_arm">{arm}<collision><geometry><box size="0.1 0.1 0.135"/></geometry></collision></link>
  <link name="{s}_cover">{cover}</link><link name="{s}_wheel">{tyre}
    <collision><origin rpy="1.5708 0 0"/><geometry><cylinder radius="0.1" length="0.04"/></geometry></collision></link>
  <joint name="{s}_hip" type="revolute"><parent link="base"/><child link="{s}_arm"/><origin xyz="0 {y} -0.2"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
  <joint name="{s}_fix" type="fixed"><parent link="{s}_arm"/><child link="{s}_cover"/></joint>
  <joint name="{s}_axle" type="continuous"><parent link="{s}_arm"/><child link="{s}_wheel"/><origin xyz="0 0 -0.2"/>
    <axis xyz="0 1 0"/></joint>"""


def of_mass(kg: float, inertia: str = ".002") -> str:
    moments = " ".join(f'{axis}="{inertia}"' for axis in ("ixx", "iyy", "izz"))
    return f'<inertial><mass value="{kg}"/><inertia {moments} ixy="0" ixz="0" iyz="0"/></inertial>'


def sided(folder, **right: str):
    """Return the case of a URDF robot; ``right`` replaces the inertials of the right side's ``arm`` or ``cover``."""
    both = {"arm": of_mass(1.35), "cover": of_mass(0.03), "tyre": of_mass(0.5)}
    sides = SIDE.format(s="l", y=0.3, **both) + SIDE.format(s="r", y=-0.3, **(both | right))
    base = f'<link name="base">{of_mass(5)}<collision><geometry>{BOX}</geometry></collision></link>'
    (folder / "robot.urdf").write_text(f'<robot name="b">{base}{sides}</robot>')
    return case_of(folder / "robot.urdf")


@pytest.mark.parametrize(
    ("right", "said"),
    [
        ({}, []),
        ({"arm": ""}, ["'r_arm' has no mass in the file, unlike its mirror image"]),
        ({"cover": of_mass(0)}, ["'r_cover' has no mass in the file, unlike its mirror image"]),
        ({"cover": of_mass(1e-6)}, ["'r_cover' has no mass in the file, unlike its mirror image"]),
    ],
)
def test_a_link_without_mass_whose_mirror_image_has_one_is_found(right, said, tmp_path):
    assert [finding.message for finding in found("mirror_images", sided(tmp_path, **right))] == said


# The hips are 1 m above the root link; thigh, shank, and wheel reach 0.7 m down.
HIGH = re.sub('(name="._thigh" pos="0.0 -?0.2) 0"', r'\1 1"', two_legged().replace('mass="4"', 'mass="4" pos="0 0 1"'))


@pytest.mark.parametrize(
    ("rule", "text", "said"),
    [
        ("balance_pose", mjcf(leg("l", 0.2)), "the robot stands on one wheel, 'l_axle', and falls sideways"),
        ("robot_size", HIGH, "'trunk' is 300 mm below the ground"),
        ("robot_size", seeded(('mass="4"', 'mass="4000"')), "kg/m³"),
    ],
    ids=["one wheel", "root link below the ground", "mass and size"],
)
def test_a_robot_as_a_whole(rule, text, said, tmp_path):
    (finding,) = found(rule, patient(tmp_path, text))
    assert said in finding.message


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (TRUNK, TRUNK.replace("0.02 0.06 0.07", "2 6 7"), "as if its mass were 1.32e+03 mm from its centre"),
        (TRUNK, TRUNK.replace("0.02 0.06 0.07", "2e-7 6e-7 7e-7"), "less than a link that reaches 229 mm can have"),
        (TRUNK, TRUNK.replace('pos="0 0 0"', 'pos="0 0 0.5"'), "lies 450 mm outside its shapes"),
    ],
)
def test_masses_that_no_link_has(old, new, said, tmp_path):
    assert any(said in finding.message for finding in found("link_masses", patient(tmp_path, seeded((old, new)))))


def test_moments_of_inertia_that_no_body_has(tmp_path):
    base = GIVEN.replace('izz=".01"', 'izz=".05"')
    assert "0.01, 0.01, 0.05 kg·m²" in found("link_masses", read_urdf(tmp_path, inertial=base))[0].message
    case = patient(tmp_path)
    case.robot.model.body_inertia[case.robot.model.body("trunk").id] = (0.01, 0.02, 0.06)
    assert "0.01, 0.02, 0.06 kg·m²" in only("link_masses", case)


def test_efforts_and_speeds_that_no_motor_has(tmp_path):
    big = patient(tmp_path, seeded((BENDS, BENDS.replace("30", "1e5"))))
    assert "'r_knee' has effort limits beyond" in only("placeholder_limits", big)
    none = patient(tmp_path, seeded((BENDS, BENDS.replace("30 30", "0 1e-99").replace("-0", "0"))))
    assert found("placeholder_limits", none) == []  # The rule effort_against_load reports a tiny effort limit.


def test_a_robot_without_colliders_is_found(tmp_path):
    bare = HEALTHY.replace("<geom ", '<geom contype="0" conaffinity="0" ')
    assert [finding.rule for finding in all_findings(patient(tmp_path, bare))][:1] == ["no_colliders"]
    assert len(found("no_colliders", patient(tmp_path, bare))) == 1


def test_a_lopsided_pose(tmp_path):
    text = seeded((f"{HIP} {KNEE} 0 {HIP} {KNEE} 0", f"{HIP} {KNEE} 0 {HIP} {KNEE + 0.1} 0"))
    (finding,) = found("lopsided_pose", patient(tmp_path, text))
    assert "l_knee at -0.8 and r_knee at -0.7" in finding.message
    assert "r_knee: -0.8" in finding.hint
    assert found("lopsided_pose", patient(tmp_path)) == []


def contact(*names: str) -> dict:
    entity = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "contact_forces", "body_names": list(names)}
    return {"touch": term("terminations.illegal_contact", threshold=1.0, sensor_cfg=entity)}


def test_a_termination_on_what_touches_at_the_start(tmp_path):
    (finding,) = found("contact_at_start", patient(tmp_path, terminations=contact("trunk", "l_wheel", "r_wheel")))
    assert "'l_wheel', 'r_wheel' touch something" in finding.message
    assert found("contact_at_start", patient(tmp_path, terminations=contact("trunk", "._thigh", "._shank"))) == []
    (finding,) = found("contact_at_start", patient(tmp_path, pack(0.012), terminations=contact("._thigh", "trunk")))
    assert "'l_thigh' touch something" in finding.message


def test_a_reset_into_the_ground(tmp_path):
    def reset(**ranges):
        return {"base": term("events.reset_root_state_uniform", mode="reset", pose_range=ranges, velocity_range={})}

    (finding,) = found("reset_into_ground", patient(tmp_path, events=reset(z=[-0.05, 0.0])))
    assert "reach 50 mm into the ground" in finding.message
    (finding,) = found("reset_into_ground", patient(tmp_path, events=reset(roll=[-0.2, 0.2])))
    # The base rolls around its origin. The rim of the lower wheel is 0.2 + 0.02 m to the side.
    height = 2 * LINK * math.cos(HIP) + 0.1
    low = 0.22 * math.sin(0.2) + (height - 0.1) * math.cos(0.2) + 0.1 * math.cos(0.2) - height
    assert finding.figures["depth_m"] == pytest.approx(low, abs=1e-4)
    both = patient(tmp_path, events=reset(roll=[0.4, 0.4], pitch=[0.15, 0.15]))
    (finding,) = found("reset_into_ground", both)
    # The world's z axis in the base frame is the last row of R_y(pitch) R_x(roll), because resets rotate about fixed
    # axes.
    x, y, z = -math.sin(0.15), math.cos(0.15) * math.sin(0.4), math.cos(0.15) * math.cos(0.4)
    low = 0.22 * y + (height - 0.1) * z + 0.1 * math.hypot(x, z) - height
    assert finding.figures["depth_m"] == pytest.approx(low, abs=1e-4)
    assert found("reset_into_ground", patient(tmp_path, events=reset(roll=[-0.01, 0.01], x=[-1, 1]))) == []
    legs = term("events.reset_joints_by_offset", mode="reset", position_range=[0.0, 0.4], velocity_range=[0, 0],
                asset_cfg=joints("._knee"))  # fmt: skip
    assert found("reset_into_ground", patient(tmp_path, events={**reset(z=[0, 0]), "legs": legs}))


URDF = """<robot name="two"><link name="base">{inertial}
  <collision><geometry>{shape}</geometry></collision></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="{low}" upper="1" effort="{effort}" velocity="1"/></joint>
  <link name="arm">{given}<collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision></link></robot>"""
GIVEN = of_mass(1, ".01")
BOX = '<box size="0.3 0.3 0.3"/>'


def read_urdf(folder, inertial=GIVEN, shape=BOX, low=-1, effort=1):
    file = folder / "robot.urdf"
    file.write_text(URDF.format(inertial=inertial, shape=shape, low=low, effort=effort, given=GIVEN))
    return case_of(file)


def test_missing_meshes_masses_and_limits_of_a_file_are_found(tmp_path):
    whole = read_urdf(tmp_path)
    for rule in ("missing_files", "assumed_masses", "lost_in_conversion"):
        assert found(rule, whole) == []
    (finding,) = found("missing_files", read_urdf(tmp_path, shape='<mesh filename="gone.stl"/>'))
    assert finding.message == "colliders are missing: gone.stl (the file is missing)"
    (finding,) = found("assumed_masses", read_urdf(tmp_path, inertial=""))
    assert finding.figures["assumed_kg"] == pytest.approx(0.3**3 * 1000)  # The assumed density is that of water.
    assert "of 28 kg are assumed (96 %)" in finding.message
    (finding,) = found("assumed_masses", read_urdf(tmp_path, inertial='<inertial><mass value="2"/></inertial>'))
    assert "1 link has a mass and no inertia, such as 'base': the tensor is computed from the shapes" in finding.message
    idle = read_urdf(tmp_path, effort=0)
    assert "'j' has an effort or velocity limit of 0 in the file" in found("placeholder_limits", idle)[0].message
    assert found("placeholder_limits", replace(idle, of_task=True)) == []
    (finding,) = found("lost_in_conversion", read_urdf(tmp_path, low=2))
    assert "wrong way round" in finding.message


def test_the_armature_is_the_only_finding_of_the_stock_robot():
    findings = diagnose_file(assets_dir() / "wheelleg" / "wheelleg.usda").findings
    assert {finding.rule for finding in findings} <= {"armature_ratio"}


@pytest.mark.parametrize("ground", ["box", "hfield", "plane"])
@pytest.mark.parametrize(("version", "wheel"), [("4.0.0", "cylinder"), ("4.0.1", "cylinder"), ("4.0.0", "sphere")])
def test_cylinders_on_ground_with_edges_are_found_with_mujoco_4_0_0_only(tmp_path, monkeypatch, version, wheel, ground):
    monkeypatch.setattr(mujoco, "mj_versionString", lambda: version)
    case = patient(tmp_path, seeded((CYLINDER, CYLINDER.replace("cylinder", wheel)), everywhere=True))
    spec = mujoco.MjSpec.from_string(HEALTHY.replace("cylinder", wheel))
    spec.add_hfield(name="hfield", nrow=2, ncol=2, size=[1, 1, 1, 1], userdata=[0, 0, 0, 1])
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{ground.upper()}")
    spec.worldbody.add_geom(type=kind, size=[1, 1, 1], hfieldname="hfield" * (ground == "hfield"))
    on_ground = replace(case, robot=replace(case.robot, model=spec.compile()))
    keys = [finding.key for finding in found("cylinder_edges", on_ground)]
    assert keys == ["env.scene.terrain"] * (version == "4.0.0" and wheel == "cylinder" and ground != "plane")


def test_actuators_of_an_mjcf_add_up_and_the_joint_limits_them(tmp_path):
    actuators = """<actuator><position joint="l_hip" kp="50"/><velocity joint="l_hip" kv="2"/>
      <motor joint="r_hip" gear="10" ctrllimited="true" ctrlrange="-1 2"/></actuator></mujoco>"""
    text = HEALTHY[: HEALTHY.index("<actuator>")].replace('name="l_hip"', 'name="l_hip" actuatorfrcrange="-3 3"')
    drives = _drives_of_mjcf(mujoco.MjModel.from_xml_string(text + actuators))
    assert drives["l_hip"] == Drive("", 50.0, 2.0, 3.0, math.inf)
    assert drives["r_hip"] == Drive("", 0.0, 0.0, 20.0, math.inf)


LEANS = "the centre of mass above the wheels"


@pytest.mark.parametrize(
    ("low", "high", "at"),
    [(0.0, 2.5, 0.0), (-2.5, 0.0, 0.0), (-1.5, 2.5, 0.0), (0.02, 2.5, 0.02), (-2.5, -0.7, -0.7)],
)
def test_the_pose_of_a_file_is_measured_as_drawn_or_at_the_nearest_limits(tmp_path, low, high, at):
    file = edited(knees(tmp_path), ('lower="-2.5" upper="2.5"', f'lower="{low}" upper="{high}"'))
    case = case_of(file)
    assert [case.robot.position(name) for name in ("l_hip", "l_knee", "r_knee")] == pytest.approx([0.0, at, at])
    assert found("balance_pose", case) == []
    (lean,) = [note for note in notes_on(case) if note.startswith(LEANS)]
    assert ("+0.0°" in lean) == (at == 0.0)  # The robot stands upright as drawn.
    moved = [note for note in notes_on(case) if "outside joint limits" in note]
    pose = f"l_knee at {at:.4g}, not 0, r_knee at {at:.4g}, not 0"
    assert [note.endswith(f"measured with {pose}") for note in moved] == ([True] if at else [])


def test_a_lean_as_drawn_is_found(tmp_path):
    case = case_of(edited(knees(tmp_path), ('<mass value="2.0"/>', '<origin xyz="0.2 0 0"/><mass value="2.0"/>')))
    assert found("balance_pose", case)[0].figures["lean_rad"] > 0.17


@pytest.mark.parametrize(("state", "at"), [("", 0.0), ("float state:angular:physics:position = 20", 20.0)])
def test_a_saved_state_is_the_pose_of_a_file_and_a_drives_target_is_not(tmp_path, state, at):
    drive = "float drive:angular:physics:targetPosition = 40\n float drive:angular:physics:stiffness = 5"
    apis = "PhysicsDriveAPI:angular PhysicsJointStateAPI:angular"
    links = link("a") + link("b", inside=cube_inside("convexHull"))
    file = write(tmp_path, links + hinge("j", "a", "b", apis=apis, text=f"{drive}\n{state}"))
    assert math.degrees(case_of(file).robot.position("j")) == pytest.approx(at, abs=1e-4)


def test_a_follower_in_a_file_follows_and_has_no_motor_of_its_own(tmp_path):
    mimic = '<mimic joint="l_hip" multiplier="-1.5" offset="-0.5"/></joint>'
    path = knees(tmp_path)
    knee = path.read_text().split('<joint name="l_knee"')[1].split("</joint>")[0]
    case = case_of(edited(path, (knee + "</joint>", knee + mimic)))
    assert (case.robot.position("l_knee"), case.robot.moved) == (pytest.approx(-0.5), {})
    assert (case.facts.joints["l_knee"].drive, case.facts.joints["r_knee"].drive.effort) == (None, 8.0)
    # The knee is below its upper limit of -0.8 only while the hip is above 0.2.
    case = case_of(edited(path, ('lower="-2.5" upper="2.5"', 'lower="-2.5" upper="-0.8"')))
    assert (case.robot.position("l_hip"), case.robot.position("l_knee")) == pytest.approx((0.2, -0.8), abs=1e-3)
    assert set(case.robot.moved) == {"l_hip", "r_knee"}
