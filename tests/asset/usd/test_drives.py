"""Drives, limits, saved states, and passive forces of single joints become SI values from any USD unit."""

import math

import mujoco
import numpy as np
import pytest

from ..small_usd import DEGREES, MASS, converted, hinge, link, two_links, write

CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    kilogramsPerUnit = 0.001\n    upAxis = "Z"'


def drive(kind: str = "angular", **values: float | str) -> str:
    return "\n".join(f"float drive:{kind}:physics:{name} = {value}" for name, value in values.items()) + "\n"


def limits(low: float | str, high: float | str) -> str:
    return f"float physics:lowerLimit = {low}\n float physics:upperLimit = {high}\n"


def driven(folder, text: str, **options: object):
    return two_links(folder, text, apis="PhysicsDriveAPI:angular", **options)


# ------------------------------------------------------------------ drives
@pytest.mark.parametrize(
    ("kp", "kd", "gain", "bias"),
    [
        (2.0, 0.5, 2.0 * DEGREES, [0, -2.0 * DEGREES, -0.5 * DEGREES]),
        (0.0, 0.5, 0.5 * DEGREES, [0, 0, -0.5 * DEGREES]),
        (0.0, 0.0, 1.0, [0, 0, 0]),
    ],
    ids=["position", "velocity", "motor"],
)
def test_angular_gains_are_per_degree(tmp_path, kp, kd, gain, bias):
    model, _ = driven(tmp_path, drive(stiffness=kp, damping=kd, maxForce=7))
    motor = model.actuator("j")
    assert motor.gainprm[0] == pytest.approx(gain, rel=1e-6)
    np.testing.assert_allclose(motor.biasprm[:3], bias, rtol=1e-6)
    np.testing.assert_allclose(motor.forcerange, [-7, 7])


@pytest.mark.parametrize("force", ["0", "-5", "inf", "3.4028235e38"])
def test_an_infinite_or_not_positive_effort_limit_is_no_limit(tmp_path, force):
    model, done = driven(tmp_path, drive(stiffness=1, maxForce=force))
    assert not model.actuator_forcelimited[0]
    assert any("maxForce" in item.rule for item in done.report.assumptions) is (float(force) <= 0)


def test_targets_and_saved_state_become_the_home_keyframe(tmp_path):
    state = "float state:angular:physics:position = 30\n float state:angular:physics:velocity = 60"
    apis = "PhysicsDriveAPI:angular PhysicsJointStateAPI:angular"
    model, _ = two_links(tmp_path, drive(stiffness=1, targetPosition=90) + state, apis=apis)
    key = model.key("home")
    assert np.degrees([key.qpos[-1], key.qvel[-1], key.ctrl[0]]) == pytest.approx([30, 60, 90])


STATE = "float state:angular:physics:position = 30"


@pytest.mark.parametrize(("text", "rule"), [(STATE, "outside the limits"), (drive(targetPosition=45), "target")])
def test_a_saved_state_or_target_beyond_the_limits_is_clamped_and_reported(tmp_path, text, rule):
    text += "\n" + limits(-10, 10) + drive(stiffness=1)
    model, done = two_links(tmp_path, text, apis="PhysicsDriveAPI:angular PhysicsJointStateAPI:angular")
    key = model.key("home")
    assert (key.qpos[-1] if rule != "target" else key.ctrl[0]) == pytest.approx(math.radians(10), rel=1e-6)
    assert any(rule in item.rule and "clamped" in item.rule for item in done.report.assumptions)


def test_newton_damping_is_per_degree_and_mujocos_is_per_radian(tmp_path):
    for text, damping in (("", 0.01 * DEGREES), ("\n float mjc:damping = 0.5", 0.5)):
        model, _ = two_links(tmp_path, f"float newton:damping = 0.01{text}")
        assert model.dof_damping[6] == pytest.approx(damping, rel=1e-6)


# ------------------------------------------------------------------ limits
UNLIMITED = [("-inf", "inf"), ("-57295776", "57295776"), ("-99999990", "99999990"), ("-1e38", "1e38")]
UNLIMITED += [("-3.4e38", "3.4e38"), ("0", "0"), ("-10", "inf"), ("", "")]
SLIDES = [("-inf", "inf"), ("-1e30", "1e30"), ("0", "0"), ("0.3", "0.3")]


@pytest.mark.parametrize(
    ("kind", "ends"), [*(("Revolute", ends) for ends in UNLIMITED), *(("Prismatic", ends) for ends in SLIDES)]
)
def test_a_joint_without_real_limits_is_unlimited(tmp_path, kind, ends):
    model, done = two_links(tmp_path, limits(*ends) if any(ends) else "", kind=kind)
    assert not model.jnt_limited[1]
    locks = any("/bot/j" in warning and "PhysX locks" in warning for warning in done.report.warnings)
    assert locks is (ends in {("0", "0"), ("0.3", "0.3")})


@pytest.mark.parametrize("kind", ["Revolute", "Prismatic"])
def test_limits_the_wrong_way_round_lock_the_joint_as_in_physx(tmp_path, kind):
    model, done = two_links(tmp_path, limits(30, -30), kind=kind)
    assert model.nv == 7
    np.testing.assert_allclose(model.jnt_range[1], [-1e-4, 1e-4])
    assert any("/bot/j" in warning and "locked" in warning for warning in done.report.warnings)


def test_a_cone_that_is_closed_leaves_a_hinge_about_its_axis(tmp_path):
    text = 'float physics:coneAngle0Limit = 0\n float physics:coneAngle1Limit = 0\n uniform token physics:axis = "Y"'
    model, _ = two_links(tmp_path, text, kind="Spherical")
    assert model.jnt_type[1] == mujoco.mjtJoint.mjJNT_HINGE
    np.testing.assert_allclose(model.jnt_axis[1], [0, 1, 0])


CONES = [(("-1", "-1"), None), (("30", "-1"), 30), (("0", "30"), 30), (("40", "30"), 30), (("30", "40"), 30)]


@pytest.mark.parametrize(("angles", "limit"), CONES)
def test_the_smaller_angle_of_a_cone_limits_a_ball(tmp_path, angles, limit):
    text = f"float physics:coneAngle0Limit = {angles[0]}\n float physics:coneAngle1Limit = {angles[1]}"
    model, done = two_links(tmp_path, text, kind="Spherical")
    assert model.jnt_type[1] == mujoco.mjtJoint.mjJNT_BALL
    assert any("cone angles" in warning for warning in done.report.warnings) is ("-1" not in angles)
    assert bool(model.jnt_limited[1]) is (limit is not None)
    if limit:
        assert model.jnt_range[1][1] == pytest.approx(math.radians(limit), rel=1e-6)


# ------------------------------------------------------------------ targets and efforts


def test_a_target_velocity_is_the_control_of_a_velocity_drive(tmp_path):
    model, _ = driven(tmp_path, drive(damping=1, targetVelocity=90))
    assert model.key("home").ctrl[0] == pytest.approx(math.pi / 2, rel=1e-6)


def test_an_acceleration_drive_meets_the_inertia_of_a_pendulum(tmp_path):
    """The pendulum's inertia is 0.1 + 2·0.5² + 0.05 (armature) kg m²."""
    mass = MASS.replace("mass = 1", "mass = 2").replace("centerOfMass = (0, 0, 0)", "centerOfMass = (0, 0.5, 0)")
    text = 'uniform token drive:angular:physics:type = "acceleration"\n float physxJoint:armature = 0.05\n'
    text += drive(stiffness=3, damping=0.2)
    joint = hinge("j", "x", "b", apis=HINGED, text=text).replace("rel physics:body0 = </bot/x>", "")
    model, _ = converted(write(tmp_path, link("b", mass=mass) + joint))
    gain = DEGREES * (0.1 + 2 * 0.5**2 + 0.05)
    np.testing.assert_allclose(model.actuator("j").biasprm[:3], [0, -3 * gain, -0.2 * gain], rtol=1e-6)


# ------------------------------------------------------------------ units
GRAMS = "float physics:mass = 1000\n float3 physics:diagonalInertia = (1e6, 1e6, 1e6)"
HINGED = "PhysicsDriveAPI:angular PhysxJointAPI"


def test_a_hinge_in_centimetres_and_grams(tmp_path):
    """Torques and angular gains of the USD file are multiplied by kpu·mpu² = 1e-7."""
    text = drive(stiffness=2e7, damping=1e7, maxForce=3e7)
    text += "float physxJoint:armature = 5e6\n float newton:friction = 4e6"
    body = link("a", mass=GRAMS) + link("b", mass=GRAMS) + hinge("j", "a", "b", apis=HINGED, text=text)
    model, _ = converted(write(tmp_path, body, header=CM))
    np.testing.assert_allclose(model.actuator("j").biasprm[:3], [0, -2 * DEGREES, -1 * DEGREES], rtol=1e-6)
    np.testing.assert_allclose(model.actuator("j").forcerange, [-3, 3], rtol=1e-6)
    assert (model.dof_armature[6], model.dof_frictionloss[6]) == (pytest.approx(0.5), pytest.approx(0.4))


def test_a_slide_in_centimetres_and_grams(tmp_path):
    """Forces of the USD file are multiplied by kpu·mpu = 1e-5, linear gains and masses by kpu = 1e-3."""
    text = drive("linear", stiffness=2000, damping=500, maxForce=3e5, targetPosition=5) + limits(-20, 30)
    text += "float physxJoint:armature = 500\n float newton:damping = 700\n float physxJoint:maxJointVelocity = 250\n"
    text += "float state:linear:physics:position = 10\n float state:linear:physics:velocity = 40"
    joint = hinge("j", "a", "b", kind="Prismatic", apis="PhysicsDriveAPI:linear PhysxJointAPI", text=text)
    model, done = converted(write(tmp_path, link("a") + link("b") + joint, header=CM))
    np.testing.assert_allclose(model.actuator("j").biasprm[:3], [0, -2, -0.5], rtol=1e-6)
    np.testing.assert_allclose(model.actuator("j").forcerange, [-3, 3], rtol=1e-6)
    np.testing.assert_allclose(model.jnt_range[1], [-0.2, 0.3], rtol=1e-6)
    assert (model.dof_armature[6], model.dof_damping[6]) == (pytest.approx(0.5), pytest.approx(0.7))
    assert done.report.velocity_limits["j"] == pytest.approx(2.5)
    key = model.key("home")
    np.testing.assert_allclose([key.ctrl[0], key.qpos[-1], key.qvel[-1]], [0.05, 0.1, 0.4], rtol=1e-6)


# ------------------------------------------------------------------ passive forces
ARMATURES = ("mjc:armature", "newton:armature", "physxJointAxis:angular:armature", "physxJoint:armature")


HIGHEST = ("newton:velocityLimit", "physxJointAxis:angular:maxJointVelocity", "physxJoint:maxJointVelocity")


@pytest.mark.parametrize(
    "names", [*(ARMATURES[first:] for first in range(4)), *(HIGHEST[first:] for first in range(3))]
)
def test_the_first_schema_with_an_armature_or_velocity_limit_wins_and_the_others_are_named(tmp_path, names):
    text = "\n".join(f"float {name} = {90 * (index + 1)}" for index, name in enumerate(names))
    model, done = two_links(tmp_path, text)
    if names[-1] == HIGHEST[-1]:
        assert done.report.velocity_limits["j"] == pytest.approx(math.pi / 2, rel=1e-6)
    else:
        assert model.dof_armature[6] == 90
    left = {item.name: item.reason for item in done.report.left_out}
    assert all(names[0] in left[name] for name in names[1:])


def test_an_axis_schema_replaces_the_armature_and_velocity_limit_of_the_joint(tmp_path):
    text = "float physxJoint:armature = 9\n float physxJoint:maxJointVelocity = 180"
    model, done = two_links(tmp_path, text, apis="PhysxJointAPI PhysxJointAxisAPI:angular")
    assert model.dof_armature[6] == 0
    assert "j" not in done.report.velocity_limits


def test_a_ball_reads_its_three_axes(tmp_path):
    text = "\n".join(
        f"float physxJointAxis:rot{axis}:armature = {number}\n"
        f"float physxJointAxis:rot{axis}:maxJointVelocity = {180 * number}"
        for axis, number in zip("XYZ", (1, 2, 3), strict=True)
    )
    model, done = two_links(tmp_path, text, kind="Spherical")
    np.testing.assert_allclose(model.dof_armature[6:], 3)
    assert done.report.velocity_limits["j"] == pytest.approx(math.pi, rel=1e-6)
    assert sum("differs between the axes of a ball, 3" in warning for warning in done.report.warnings) == 2


def test_static_friction_is_used_if_no_dynamic_friction_is_given(tmp_path):
    model, _ = two_links(tmp_path, "float physxJointAxis:angular:staticFrictionEffort = 0.6")
    assert model.dof_frictionloss[6] == pytest.approx(0.6)


def test_limits_targets_and_gains_of_a_reversed_joint_stay_as_authored(tmp_path):
    text = limits(-10, 40) + drive(stiffness=2, targetPosition=25) + "float state:angular:physics:position = 15"
    body = link("a", apis="PhysicsArticulationRootAPI") + link("b")
    model, _ = converted(write(tmp_path, body + hinge("j", "b", "a", apis="PhysicsDriveAPI:angular", text=text)))
    np.testing.assert_allclose(model.jnt_axis[1], [-1, 0, 0])
    np.testing.assert_allclose(model.jnt_range[1], np.radians([-10, 40]), rtol=1e-6)
    assert model.actuator("j").gainprm[0] == pytest.approx(2 * DEGREES, rel=1e-6)
    key = model.key("home")
    np.testing.assert_allclose([key.ctrl[0], key.qpos[-1]], np.radians([25, 15]), rtol=1e-6)


def test_a_speed_target_with_a_stiffness_is_reported_with_the_rest_position_of_physx(tmp_path):
    """k (q* - q) + d v* = 0 at q = q* + d v*/k: 2·(π/2)/4 rad."""
    _, done = driven(tmp_path, drive(stiffness=4, damping=2, targetVelocity=90))
    (entry,) = [item for item in done.report.left_out if item.name == "drive:angular:physics:targetVelocity"]
    assert float(entry.values["/bot/j"].split()[0]) == pytest.approx(math.pi / 4, rel=1e-5)
    assert any("targetVelocity" in warning for warning in done.report.warnings)
    assert "drive:angular:physics:targetVelocity" not in {item.name for item in done.report.mapped}


def test_drives_with_gains_are_integrated_implicitly_as_in_physx(tmp_path):
    integrators = mujoco.mjtIntegrator
    for text, integrator in ((drive(stiffness=1000), "IMPLICITFAST"), (drive(maxForce=3), "EULER")):
        model, _ = driven(tmp_path, text)
        assert model.opt.integrator == int(getattr(integrators, f"mjINT_{integrator}"))
