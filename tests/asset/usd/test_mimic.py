"""PhysX's mimic joints obey q = -gearing · reference - offset, in degrees and stage lengths."""

import math

import mujoco
import numpy as np
import pytest

from ..small_usd import SI, converted, hinge, link, locked, write

CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    upAxis = "Z"'


def mimic(axis: str = "rotX", gearing: float = 2, offset: float = 0, reference: str = "ab", of: str = "rotX") -> str:
    leader = f'rel :referenceJoint = </bot/{reference}>\n uniform token :referenceJointAxis = "{of}"\n'
    spring = "float :naturalFrequency = 25\n float :dampingRatio = 0.005"
    text = f"{leader} float :gearing = {gearing}\n float :offset = {offset}\n {spring}"
    return text.replace(" :", f" physxMimicJoint:{axis}:")


def three(folder, text: str, *, lead: str = "Revolute", follow: str = "Revolute", axis: str = "rotX", header: str = SI):
    body = link("a") + link("b") + link("c") + hinge("ab", "a", "b", kind=lead)
    body += hinge("bc", "b", "c", kind=follow, apis=f"PhysxMimicJointAPI:{axis}", text=text)
    return converted(write(folder, body, header=header))


def settled(model: mujoco.MjModel, value: float) -> float:
    data = mujoco.MjData(model)
    data.joint("ab").qpos = value
    mujoco.mj_forward(model, data)
    (error,) = data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
    return -float(error)


@pytest.mark.parametrize("axis", ["rotX", "rotY", "rotZ"])
def test_angles_follow_with_an_offset_in_degrees(tmp_path, axis):
    model, done = three(tmp_path, mimic(axis, gearing=2, offset=30), axis=axis)
    assert settled(model, 0.4) == pytest.approx(-2 * 0.4 - math.radians(30), rel=1e-6)
    left = {item.name for item in done.report.left_out}
    assert {f"physxMimicJoint:{axis}:naturalFrequency", f"physxMimicJoint:{axis}:dampingRatio"} <= left


SLIDES = {"lead": "Prismatic", "follow": "Prismatic", "header": CM}
DEGREE = math.radians(1)


@pytest.mark.parametrize(
    ("text", "options", "leader", "follower"),
    [
        (mimic(gearing=-1, offset=5), SLIDES, 0.02, 0.02 - 0.05),
        (mimic(gearing=-3), {"lead": "Prismatic", "header": CM}, 0.02, 3 * 2 * DEGREE),  # 2 cm, 3° each
        (mimic(gearing=-0.5, offset=1), {"follow": "Prismatic", "header": CM}, 10 * DEGREE, (0.5 * 10 - 1) * 0.01),
        ("rel physxMimicJoint:rotX:referenceJoint = </bot/ab>", {}, 0.3, -0.3),
    ],
    ids=["a slide follows a slide", "a hinge follows a slide", "a slide follows a hinge", "the default gearing is 1"],
)
def test_coordinates_follow_in_degrees_and_stage_lengths(tmp_path, text, options, leader, follower):
    model, _ = three(tmp_path, text, **options)
    assert settled(model, leader) == pytest.approx(follower, rel=1e-6)


def test_an_axis_of_a_generic_joint_follows_and_is_followed(tmp_path):
    lock = locked("transX", "transY", "transZ", "rotX")
    follow = f"{lock}\n{mimic('rotZ', gearing=2, of='rotY')}"
    body = link("a") + link("b") + link("c") + hinge("ab", "a", "b", kind="", text=lock)
    body += hinge("bc", "b", "c", kind="", apis="PhysxMimicJointAPI:rotZ", text=follow)
    model, _ = converted(write(tmp_path, body))
    follower, leader = model.eq_obj1id[0], model.eq_obj2id[0]
    assert (model.joint(follower).name, model.joint(leader).name) == ("bc_rotZ", "ab_rotY")
    np.testing.assert_allclose(model.eq_data[0][:2], [0, -2])


def test_the_rule_holds_for_coordinates_of_reversed_joints(tmp_path):
    body = link("a", apis="PhysicsArticulationRootAPI") + link("b") + link("c") + hinge("ab", "b", "a")
    body += hinge("bc", "b", "c", apis="PhysxMimicJointAPI:rotX", text=mimic(gearing=2))
    model, _ = converted(write(tmp_path, body))
    assert settled(model, 0.4) == pytest.approx(-0.8)


@pytest.mark.parametrize("reference", ["nobody", "bc", "weld"])
def test_a_joint_that_follows_no_coordinate_is_left_out_and_named(tmp_path, reference):
    body = link("a") + link("b") + link("c") + link("d") + hinge("ab", "a", "b") + hinge("weld", "a", "d", kind="Fixed")
    body += hinge("bc", "b", "c", apis="PhysxMimicJointAPI:rotX", text=mimic(reference=reference))
    model, done = converted(write(tmp_path, body))
    assert model.neq == 0
    assert any("/bot/bc" in warning for warning in done.report.warnings)
