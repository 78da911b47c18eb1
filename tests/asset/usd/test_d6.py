"""The axes of a generic USD joint are free, locked at zero, or locked at a nonzero value."""

import math
from itertools import product

import mujoco
import numpy as np
import pytest

from ..small_usd import AXES, DEGREES, converted, hinge, limits, link, locked, two_links, warned, write


def generic(folder, text: str, **options: object):
    apis = " ".join(f"PhysicsLimitAPI:{axis}" for axis in AXES if f"limit:{axis}:" in text)
    drives = " ".join(f"PhysicsDriveAPI:{axis}" for axis in AXES if f"drive:{axis}:" in text)
    return two_links(folder, text, apis=f"{apis} {drives}", kind="", **options)


def names(model: mujoco.MjModel) -> list[str]:
    return [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]


@pytest.mark.parametrize("free", list(product([False, True], repeat=6)))
def test_every_combination_of_free_axes(tmp_path, free):
    kept = [axis for axis, is_free in zip(AXES, free, strict=True) if is_free]
    model, _ = generic(tmp_path, locked(*(axis for axis in AXES if axis not in kept)))
    turns = [axis for axis in kept if axis.startswith("rot")]
    wanted = [axis for axis in kept if axis.startswith("trans")] + (["rot"] if len(turns) == 3 else turns)
    assert names(model) == (["j"] if len(wanted) == 1 else [f"j_{axis}" for axis in wanted])
    assert model.nv - 6 == len(kept)
    kinds = {"trans": mujoco.mjtJoint.mjJNT_SLIDE, "rot": mujoco.mjtJoint.mjJNT_HINGE}
    for index, axis in enumerate(wanted):
        joint = 1 + index
        if axis == "rot":
            assert model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL
        else:
            assert model.jnt_type[joint] == kinds[axis[:-1]]
            np.testing.assert_allclose(model.jnt_axis[joint], np.eye(3)["XYZ".index(axis[-1])])


def test_limits_of_each_axis(tmp_path):
    text = locked("transY", "transZ", "rotX") + "\n"
    text += limits(transX=(-0.2, 0.3), rotY=("-inf", 30), rotZ=(-20, 30))
    model, _ = generic(tmp_path, text)
    np.testing.assert_allclose(model.jnt_range[1], [-0.2, 0.3], rtol=1e-6)
    assert model.joint("j_rotY").range[0] < -1e3
    assert model.joint("j_rotY").range[1] == pytest.approx(math.radians(30), rel=1e-6)
    np.testing.assert_allclose(model.joint("j_rotZ").range, np.radians([-20, 30]), rtol=1e-6)


def test_three_rotations_are_hinges_when_one_has_limits_or_a_drive(tmp_path):
    slides = locked("transX", "transY", "transZ")
    for text in (limits(rotY=(-10, 10)), "float drive:rotY:physics:stiffness = 2"):
        model, _ = generic(tmp_path, f"{slides}\n{text}")
        assert names(model) == ["j_rotX", "j_rotY", "j_rotZ"]


def test_drives_of_each_axis(tmp_path):
    text = "float drive:transX:physics:stiffness = 100\n float drive:rotY:physics:stiffness = 2\n"
    text += "float drive:rotZ:physics:damping = 3\n float drive:rotY:physics:targetPosition = 90\n"
    model, _ = generic(tmp_path, text + locked("transY", "transZ", "rotX"))
    assert model.actuator("j_transX").gainprm[0] == pytest.approx(100)
    assert model.actuator("j_rotY").gainprm[0] == pytest.approx(2 * DEGREES, rel=1e-6)
    assert model.actuator("j_rotZ").gainprm[0] == pytest.approx(3 * DEGREES, rel=1e-6)
    assert model.key("home").ctrl[1] == pytest.approx(math.pi / 2, rel=1e-6)


def test_armature_and_friction_of_each_axis(tmp_path):
    text = "float physxJoint:armature = 9\n float physxJointAxis:rotY:armature = 0.25\n"
    text += (
        "float physxJointAxis:rotY:dynamicFrictionEffort = 0.5\n float physxJointAxis:rotY:staticFrictionEffort = 0.6\n"
    )
    text += "float physxJointAxis:rotZ:viscousFrictionCoefficient = 0.01\n"
    text += "float physxJointAxis:rotY:maxJointVelocity = 180\n"
    model, done = generic(tmp_path, text + locked("transX", "transY", "transZ", "rotX"))
    np.testing.assert_allclose(model.dof_armature[6:], [0.25, 9])
    np.testing.assert_allclose(model.dof_frictionloss[6:], [0.5, 0])
    np.testing.assert_allclose(model.dof_damping[6:], [0, 0.01 * DEGREES], rtol=1e-6)
    assert done.report.velocity_limits == {"j_rotY": pytest.approx(math.pi, rel=1e-6)}


def test_equal_limits_lock_an_axis_where_they_are(tmp_path):
    text = locked("transX", "transZ", "rotX", "rotY") + "\n" + limits(transY=(0.5, 0.5), rotZ=(90, 90))
    model, done = generic(tmp_path, text)
    assert model.nv == 6
    np.testing.assert_allclose(model.body("b").pos, [1, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(model.body("b").quat, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], atol=1e-6)
    assert any("locked there" in item.rule for item in done.report.assumptions)


def test_limits_without_their_schema_are_honoured_and_reported(tmp_path):
    model, done = two_links(tmp_path, locked(*AXES[:5]), kind="")
    assert names(model) == ["j"]
    assert any("without PhysicsLimitAPI" in item.rule for item in done.report.assumptions)


def test_inside_an_articulation_a_generic_joint_does_not_slide(tmp_path):
    text = f"point3f physics:localPos0 = (1, 0, 0)\n{locked('transY', 'rotX', 'rotY')}"
    body = link("a", apis="PhysicsArticulationRootAPI") + link("b", "(1, 0, 0)")
    model, done = converted(write(tmp_path, body + hinge("j", "a", "b", kind="", text=text)))
    assert (names(model), model.jnt_type[1]) == (["j"], mujoco.mjtJoint.mjJNT_HINGE)
    assert any("/bot/j" in warning and "slide" in warning for warning in done.report.warnings)


def test_a_reversed_generic_joint_turns_the_other_way_and_shows_its_drawing(tmp_path):
    posed = '["xformOp:translate", "xformOp:rotateY", "xformOp:rotateX"]\n double xformOp:rotateX = -20\n'
    bent = link("b", "(1, 0, 0)").replace('["xformOp:translate"]', f"{posed} double xformOp:rotateY = -30")
    text = "point3f physics:localPos1 = (1, 0, 0)\n" + locked("transX", "transY", "transZ", "rotZ")
    body = link("a", apis="PhysicsArticulationRootAPI") + bent + hinge("j", "b", "a", kind="", text=text)
    model, _ = converted(write(tmp_path, body))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    assert data.joint("j_rotX").qpos[0] == pytest.approx(math.radians(20), rel=1e-5)
    assert data.joint("j_rotY").qpos[0] == pytest.approx(math.radians(30), rel=1e-5)
    mujoco.mj_kinematics(model, data)
    x, y = math.radians(-20), math.radians(-30)
    about_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    about_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    np.testing.assert_allclose(data.body("b").xmat.reshape(3, 3), about_y @ about_x, atol=1e-6)


def test_a_bent_drawing_of_several_axes_is_the_keyframe(tmp_path):
    posed = '["xformOp:translate", "xformOp:rotateY", "xformOp:rotateZ"]\n double xformOp:rotateY = 40\n'
    moved = link("b", "(1.2, 0, 0)").replace('["xformOp:translate"]', f"{posed} double xformOp:rotateZ = 10")
    text = "point3f physics:localPos0 = (1, 0, 0)\n" + locked("transY", "transZ", "rotX")
    model, done = converted(write(tmp_path, link("a") + moved + hinge("j", "a", "b", kind="", text=text)))
    np.testing.assert_allclose(model.key("home").qpos[7:], [0.2, math.radians(40), math.radians(10)], atol=1e-6)
    assert not any("the frames win" in item.rule for item in done.report.assumptions)


def test_a_generic_joint_that_locks_everything_is_mapped_and_not_warned_about(tmp_path):
    _, done = generic(tmp_path, locked(*AXES))
    mapped = {(item.name, item.became) for item in done.report.mapped if item.path == "/bot/j"}
    assert ("PhysicsJoint", "a weld to the parent body") in mapped
    assert warned(done) == ()
