import math
import re

import mujoco
import numpy as np
import pytest

from lint.bodies import RADIUS, THIGH, TRACK, WHEEL, leg, mjcf, two_legged
from wheelleg_exp.anatomy.anatomy_parts import Anatomy
from wheelleg_exp.anatomy.robot_anatomy import anatomy_of


def look(text: str, **given) -> Anatomy:
    return anatomy_of(mujoco.MjModel.from_xml_string(text), **given)


def ring(corners: int, radius: float = RADIUS, x: float = 0.0) -> str:
    """Return the vertices of a disc around the y axis."""
    angles = [2 * math.pi * k / corners for k in range(corners)]
    points = [(x + radius * math.cos(a), y, radius * math.sin(a)) for a in angles for y in (-0.02, 0.02)]
    return " ".join(f"{part:.9g}" for point in points for part in point)


def disc(corners: int, **shape: float) -> str:
    return f'<mesh name="disc" vertex="{ring(corners, **shape)}"/>'


MESH = '<geom type="mesh" mesh="disc"/>'


def with_mesh(corners: int, **shape: float) -> str:
    return mjcf(leg("l", 0.2, wheel=MESH) + leg("r", -0.2, wheel=MESH), asset=disc(corners, **shape))


def test_two_serial_legs():
    found = look(two_legged())
    assert found.wheel_joints == ["l_axle", "r_axle"]
    left, right = found.wheels
    assert (left.side, right.side, left.sign, right.sign) == ("left", "right", 1, 1)
    assert (left.radius, left.width) == (pytest.approx(RADIUS), pytest.approx(0.04))
    assert left.contact == pytest.approx((0, TRACK / 2, -0.6 - RADIUS))
    assert [leg.joints for leg in found.legs] == [("l_hip", "l_knee"), ("r_hip", "r_knee")]
    assert (found.base, found.floating, found.forward, found.up) == ("trunk", True, (1, 0, 0), (0, 0, 1))
    assert found.support_height == pytest.approx(-0.7)
    assert (found.support_width, found.support_length) == (pytest.approx(TRACK), pytest.approx(0.0))
    assert found.one_axle
    pairs = [(f"l_{name}", f"r_{name}", 1) for name in ("hip", "knee", "axle")]
    assert [(p.left, p.right, p.sign) for p in found.mirrored] == pairs
    assert found.others == found.unmatched == ()


FOOT = '<geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.02"/>'
POINT = '<geom type="sphere" pos="0 0 -0.1" size="0.03"/>'
DRAWN = WHEEL.replace("<geom", '<geom contype="0" conaffinity="0"')


@pytest.mark.parametrize(
    ("text", "reason"),  # a pattern of the reason why the axle is nearly a wheel; "" if the axle is nothing like one
    [
        (two_legged(hip="", wheel=FOOT), None),
        # The body's mass distribution is that of a wheel.
        (two_legged(hip="", wheel=POINT), ".*round about a line 100 mm off its axis.*"),
        (two_legged(axle='axis="0 1 0" range="-3.1416 3.1416"'), ".*-3.142 to 3.142 rad.*"),
        (two_legged(axle='axis="0 1 0" range="-0.5 0.5"'), ""),
        (two_legged(wheel=DRAWN), "nothing of what it turns collides"),
        (with_mesh(64, x=0.05), "its colliders are round about a line 50 mm off its axis"),
    ],
    ids=["foot", "point", "limits", "ankle", "drawn", "beside its axis"],
)
def test_a_leg_can_end_without_a_wheel_and_a_joint_that_is_nearly_a_wheel_has_a_reason(text, reason):
    found = look(text)
    assert found.wheels == ()
    if reason is not None:
        assert set(found.near) == ({"l_axle", "r_axle"} if reason else set())
        assert all(re.fullmatch(reason, text) for text in found.near.values())


def test_a_robot_on_point_feet_has_no_forward_direction():
    found = look(two_legged(hip="", wheel=POINT))
    assert (found.forward, found.support_height) == (None, None)
    assert found.others == ("l_hip", "l_knee", "l_axle", "r_hip", "r_knee", "r_axle")


@pytest.mark.parametrize("changes", [{"hip": ""}, {"axle": 'axis="0 1 0" range="-1e6 1e6"'}])
def test_leg_joints_without_limits_are_not_wheels_and_very_wide_limits_of_an_axle_do_not_count(changes):
    assert look(two_legged(**changes)).wheel_joints == ["l_axle", "r_axle"]


def test_an_axle_that_stops_after_one_turn_is_no_wheels():
    found = look(two_legged(axle='axis="0 1 0" range="-6.3 6.3"'))
    assert (found.wheel_joints, sorted(found.near)) == ([], ["l_axle", "r_axle"])


@pytest.mark.parametrize("corners", [8, 64])
def test_a_mesh_is_a_wheel_when_it_is_round(corners):
    found = look(with_mesh(corners))
    assert (found.wheel_joints, found.wheels[0].radius) == (["l_axle", "r_axle"], pytest.approx(RADIUS, rel=1e-6))
    assert found.wheels[0].roundness == pytest.approx(math.cos(math.pi / corners), rel=0.01)


def test_a_square_collider_is_a_wheel_if_its_mass_distribution_is_round():
    box = f'<geom type="box" size="{RADIUS} 0.02 {RADIUS}"/>'
    found = look(two_legged(wheel=box))
    assert (found.wheel_joints, found.wheels[0].roundness) == (["l_axle", "r_axle"], pytest.approx(math.sqrt(0.5)))
    uneven = box.replace("/>", ' mass="1"/>') + '<geom type="sphere" size="0.02" pos="0.05 0 0" mass="1"/>'
    text = two_legged(wheel=uneven).replace('<inertial pos="0 0 0" mass="0.5" diaginertia="0.002 0.003 0.002"/>', "")
    assert look(text).wheels == ()


def test_wheels_that_roll_along_y():
    turned = f'<body quat="{math.sqrt(0.5)} 0 0 {math.sqrt(0.5)}">{leg("l", 0.2)}{leg("r", -0.2)}</body>'
    found = look(mjcf(turned))
    assert found.forward == pytest.approx((0, 1, 0), abs=1e-9)
    assert [(wheel.side, wheel.sign) for wheel in found.wheels] == [("left", 1), ("right", 1)]


def test_a_wheel_that_turns_the_other_way():
    found = look(mjcf(leg("l", 0.2) + leg("r", -0.2, axle='axis="0 -1 0"')))
    assert [wheel.sign for wheel in found.wheels] == [1, -1]
    assert [(pair.left, pair.sign) for pair in found.mirrored][-1] == ("l_axle", -1)


def test_four_legs_with_wheels():
    legs = "".join(leg(f"{s}{e}", y, x) for s, y in (("l", 0.2), ("r", -0.2)) for e, x in (("f", 0.3), ("h", -0.3)))
    found = look(mjcf(legs))
    assert len(found.wheels) == len(found.legs) == 4
    assert (found.support_width, found.support_length) == (pytest.approx(0.4), pytest.approx(0.6))
    assert not found.one_axle
    assert len(found.mirrored) == 6


FIVE_BAR = """
  <body name="{side}_fore" pos="0.1 {y} 0"><joint name="{side}_1" axis="0 1 0" range="-1 1"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 -0.2" size="0.01"/>
    <body name="{side}_fore_shank" pos="0.1 0 -0.2"><joint name="{side}_2" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 -0.2 0 -0.3" size="0.01"/>
      <body name="{side}_wheel" pos="-0.2 0 -0.3"><joint name="{side}_3" axis="0 1 0"/>
        <geom type="cylinder" size="0.1 0.02" euler="90 0 0"/></body>
    </body></body>
  <body name="{side}_hind" pos="-0.1 {y} 0"><joint name="{side}_4" axis="0 1 0" range="-1 1"/>
    <geom type="capsule" fromto="0 0 0 -0.1 0 -0.2" size="0.01"/>
    <body name="{side}_hind_shank" pos="-0.1 0 -0.2"><joint name="{side}_5" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 -0.3" size="0.01"/></body></body>"""
LOOPS = """<equality>
  <connect name="close_{s}" body1="{s}_hind_shank" body2="{s}_fore_shank" anchor="0.2 0 -0.3"/></equality>"""


def test_the_second_chain_of_a_five_bar_closes_a_loop():
    body = FIVE_BAR.format(side="l", y=0.2) + FIVE_BAR.format(side="r", y=-0.2)
    motors = "".join(f'<motor joint="{s}_{n}"/>' for s in "lr" for n in (1, 3, 4))
    found = look(mjcf(body, LOOPS.format(s="l") + LOOPS.format(s="r") + f"<actuator>{motors}</actuator>"))
    assert found.wheel_joints == ["l_3", "r_3"]
    left, right = found.legs
    parts = (("l_1", "l_2"), ("l_2",), ("l_4", "l_5"), ("close_l",))
    assert (left.joints, left.passive, left.beside, left.loops) == parts
    assert (right.beside, found.others) == (("r_4", "r_5"), ())


def test_joints_that_spin_on_the_trunk_or_an_arm_are_not_wheels():
    top = '<body name="gyro" pos="0 0 0.2"><joint name="spin" axis="0 1 0"/>' + WHEEL + "</body>"
    arm = (
        '<body pos="0.2 0 0.1"><joint name="elbow" axis="0 1 0" range="-1 1"/>'
        '<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/><body pos="0.35 0 0">'
        '<joint name="wrist" axis="1 0 0"/><geom type="cylinder" size="0.03 0.02" euler="0 1.5707963 0"/></body></body>'
    )
    found = look(mjcf(leg("l", 0.2) + leg("r", -0.2) + top + arm))
    assert (found.wheel_joints, found.others) == (["l_axle", "r_axle"], ("spin", "elbow", "wrist"))


def swivel(name: str, x: float, y: float, trail: float, above: str = "") -> str:
    """Return a wheel of 0.05 m radius below an unlimited vertical joint, ``trail`` m behind the joint."""
    return f"""<body name="{name}_fork" pos="{x} {y} -0.65"><joint name="{name}_swivel" axis="0 0 1"/>
      <geom type="box" size="0.01 0.01 0.05" pos="0 0.05 0.1"/>{above}
      <body name="{name}_roller" pos="{-trail} 0 0"><joint name="{name}_roll" axis="0 1 0"/>
      <geom type="cylinder" size="0.05 0.01" euler="90 0 0"/></body></body>"""


WHEELS_DRIVE = '<actuator><motor joint="l_axle"/><motor joint="r_axle"/></actuator>'


@pytest.mark.parametrize(
    ("trail", "drives", "caster"),
    [
        (0.03, WHEELS_DRIVE, True),
        (0.03, "", True),  # The file contains no drives.
        (0.0, WHEELS_DRIVE, False),  # Without a trail the wheel is not a caster.
        (0.03, WHEELS_DRIVE.replace("<motor", '<motor joint="f_swivel"/><motor', 1), False),
    ],
)
def test_a_caster_trails_a_passive_vertical_joint(trail, drives, caster):
    found = look(mjcf(leg("l", 0.2) + leg("r", -0.2) + swivel("f", 0.3, 0.0, trail), drives))
    wheel = next(wheel for wheel in found.wheels if wheel.joint == "f_roll")
    assert (wheel.side, wheel.steered, wheel.caster, found.forward) == ("middle", True, caster, (1, 0, 0))
    assert not any(other.steered or other.caster for other in found.wheels if other is not wheel)
    assert found.casters == ({"f_swivel", "f_roll"} if caster else set())


LIGHT = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/>'
BALL = f"""<body name="fork" pos="0.3 0 -0.67"><joint name="pitch" axis="0 1 0"/>{LIGHT}
  <body><joint name="roll" axis="1 0 0"/>{LIGHT}
  <body><joint name="spin" axis="0 1 0"/><geom type="sphere" size="0.03"/></body></body></body>"""


@pytest.mark.parametrize(
    ("caster", "joints"),
    [
        (swivel("f", 0.3, 0.0, 0.03).replace('axis="0 0 1"', 'axis="0 0 1" range="-1.57 1.57"'), "f_swivel f_roll"),
        (swivel("f", 0.3, 0.0, -0.03), "f_swivel f_roll"),
        (swivel("f", 0.3, 0.1, 0.03) + swivel("b", 0.3, -0.1, 0.03), "f_swivel f_roll b_swivel b_roll"),
        (BALL, "pitch roll spin"),
        (swivel("f", 0.3, 0.0, 0.03).replace('axis="0 0 1"', 'axis="0 0 1" range="-0.6 0.6"'), ""),
    ],
    ids=["half a turn", "in front", "two", "ball", "steered"],
)
def test_the_joints_of_casters_are_known_without_motors(caster, joints):
    found = look(mjcf(leg("l", 0.2) + leg("r", -0.2) + caster))
    assert (found.casters, found.forward) == (set(joints.split()), (1, 0, 0))


def along_its_axis(side: str, y: float, shift: float) -> str:
    """Return a leg whose hip and knee are drawn ``shift`` m along their axes; nothing else changes."""
    text = leg(side, y + shift).replace('fromto="0 0 -0.05 0 0 -', f'fromto="0 {-shift} -0.05 0 {-shift} -')
    return text.replace(f'name="{side}_wheel" pos="0 0 -0.3"', f'name="{side}_wheel" pos="0 {-shift} -0.3"')


@pytest.mark.parametrize("shift", [0.05, 0.2, 0.9])
def test_the_place_of_an_anchor_on_its_hinge_axis_has_no_meaning(shift):
    plain, found = look(two_legged()), look(mjcf(leg("l", TRACK / 2) + along_its_axis("r", -TRACK / 2, shift)))
    assert [(p.left, p.right, p.sign) for p in found.mirrored] == [(p.left, p.right, p.sign) for p in plain.mirrored]
    assert [pair.offset for pair in found.mirrored] == pytest.approx([0.0] * 3, abs=1e-9)
    assert (found.unmatched, found.size, found.middle) == ((), pytest.approx(plain.size), pytest.approx(plain.middle))


@pytest.mark.parametrize("wheel", [WHEEL, MESH], ids=["cylinder", "mesh"])
def test_wheels_without_a_joint_are_named(wheel):
    text = mjcf(leg("l", 0.2, wheel=wheel) + leg("r", -0.2, wheel=wheel), asset=disc(64))
    text = re.sub('<joint name="._axle"[^>]*>', "", text)
    found = look(text)
    assert (found.wheels, set(found.near)) == ((), {"l_wheel", "r_wheel"})
    assert "fixed" in found.near["l_wheel"]
    assert "l_wheel" in found.cannot_stand
    foot = look(re.sub('<geom type="(cylinder|mesh)"[^>]*>', '<geom type="sphere" size="0.1"/>', text))
    assert (foot.near, foot.cannot_stand) == ({}, "")


WIDE = '<geom type="cylinder" size="0.1 0.05" pos="0 0.03 0" euler="1.5707963267948966 0 0"/>'


@pytest.mark.parametrize(
    ("legs", "offsets", "middle"),
    [
        (leg("l", 0.2) + leg("r", -0.2, x=0.01), [0.01] * 3, None),
        # The width of a wheel does not move the mirror.
        (leg("l", 0.2, wheel=WIDE) + leg("r", -0.2), [0.0, 0.0, 0.03], (0, 0, 0)),
        (leg("l", 0.25) + leg("r", -0.15), [0.0] * 3, (0, 0.05, 0)),
    ],
    ids=["a shifted leg", "a wide wheel", "a base that is not in the middle"],
)
def test_the_mirror_is_between_the_legs_and_offsets_from_a_mirror_image_are_measured(legs, offsets, middle):
    found = look(mjcf(legs))
    assert [pair.offset for pair in found.mirrored] == pytest.approx(offsets, abs=1e-9)
    assert middle is None or found.middle == pytest.approx(middle)


def test_positions_depend_on_the_pose():
    model = mujoco.MjModel.from_xml_string(two_legged())
    qpos = model.qpos0.copy()
    qpos[model.joint("l_hip").qposadr[0]] = qpos[model.joint("r_hip").qposadr[0]] = 0.5
    found = anatomy_of(model, qpos)
    assert found.support_height == pytest.approx(-2 * THIGH * math.cos(0.5) - RADIUS)
    assert found.wheels[0].centre[0] == pytest.approx(-2 * THIGH * math.sin(0.5))


def test_up_is_against_gravity_and_forward_is_level_for_every_rotation_of_the_base():
    quat = [math.sqrt(0.5), math.sqrt(0.5), 0, 0]  # The base's y axis points up in the world.
    text = mjcf(f'<body quat="{quat[0]} {-quat[1]} 0 0">{leg("l", 0.2)}{leg("r", -0.2)}</body>')
    model = mujoco.MjModel.from_xml_string(text)
    found = anatomy_of(model, np.array([0, 0, 1, *quat, *model.qpos0[7:]]))
    assert (found.up, found.forward) == (pytest.approx((0, 1, 0), abs=1e-9), pytest.approx((1, 0, 0), abs=1e-9))
    assert found.left == pytest.approx((0, 0, -1), abs=1e-9)


def test_a_model_without_bodies_is_refused():
    with pytest.raises(ValueError, match="no robot bodies"):
        anatomy_of(mujoco.MjModel.from_xml_string("<mujoco/>"))
