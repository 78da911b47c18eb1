"""What MuJoCo's and Newton's own USD schemas say, on small files."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from .small_usd import converted, hinge, link, two_links, write


def test_ref_is_the_coordinate_of_the_authored_pose(tmp_path):
    model, _ = two_links(tmp_path, "double mjc:ref = 30")
    data = mujoco.MjData(model)
    data.joint("j").qpos = math.radians(30)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("b").xmat.reshape(3, 3), np.eye(3), atol=1e-7)
    assert model.key("home").qpos[-1] == pytest.approx(math.radians(30))


def test_an_actuator_on_a_joint_is_kept_as_it_was_written(tmp_path):
    actuator = """
    def MjcActuator "motor"
    {
        uniform double[] mjc:gainPrm = [100, 0, 0]
        uniform double[] mjc:biasPrm = [0, -100, -2, 0]
        uniform token mjc:biasType = "affine"
        uniform double mjc:ctrlRange:min = -0.8
        uniform double mjc:ctrlRange:max = 0.9
        uniform double mjc:forceRange:min = -23
        uniform double mjc:forceRange:max = 24
        rel mjc:target = </bot/j>
    }
"""
    body = link("a") + link("b") + hinge("j", "a", "b") + actuator
    model, done = converted(write(tmp_path, body))
    motor = model.actuator("motor")
    assert motor.trnid[0] == model.joint("j").id
    assert motor.gainprm[0] == 100
    np.testing.assert_allclose(motor.biasprm[:4], [0, -100, -2, 0])
    np.testing.assert_allclose(motor.ctrlrange, [-0.8, 0.9])
    np.testing.assert_allclose(motor.forcerange, [-23, 24])
    assert done.report.totals["actuators"] == 1


def test_an_actuator_on_something_else_is_named_and_warned_about(tmp_path):
    actuator = '\n    def MjcActuator "pull"\n    {\n        rel mjc:target = </bot/a>\n    }\n'
    model, done = converted(write(tmp_path, link("a") + actuator))
    assert model.nu == 0
    assert any("/bot/pull" in warning for warning in done.report.warnings)
    assert "MjcActuator" in {item.name for item in done.report.left_out}


def test_a_joint_that_follows_another_is_an_equality(tmp_path):
    follow = "rel newton:mimicJoint = </bot/ab>\n float newton:mimicCoef0 = 0.5\n float newton:mimicCoef1 = -2"
    body = link("a") + link("b") + link("c") + hinge("ab", "a", "b")
    body += hinge("bc", "b", "c", apis="NewtonMimicAPI", text=follow)
    model, _ = converted(write(tmp_path, body))
    (kind,) = model.eq_type
    assert kind == mujoco.mjtEq.mjEQ_JOINT
    assert (model.eq_obj1id[0], model.eq_obj2id[0]) == (model.joint("bc").id, model.joint("ab").id)
    np.testing.assert_allclose(model.eq_data[0][:5], [0.5, -2, 0, 0, 0])


@pytest.mark.parametrize(("adds", "dofs", "equalities"), [(True, 2, 0), (False, 1, 0)])
def test_two_joints_between_two_bodies_add_up_only_where_the_file_says_so(tmp_path, adds, dofs, equalities):
    switch = "bool newton:jointsAddMobility = 1" if adds else ""
    first = link("a", apis="PhysicsArticulationRootAPI").replace("float physics:mass", f"{switch}\n float physics:mass")
    slides = "".join(
        hinge(name, "a", "b", kind="Prismatic", text=f'uniform token physics:axis = "{axis}"')
        for name, axis in (("x", "X"), ("y", "Y"))
    )
    model, done = converted(write(tmp_path, first + link("b") + slides))
    assert model.nv - 6 == dofs
    assert model.neq == equalities
    assert any("closes a loop" in warning for warning in done.report.warnings) is not adds


def test_the_sum_of_motors_is_limited(tmp_path):
    limits = "double mjc:actuatorfrcrange:min = -3\n double mjc:actuatorfrcrange:max = 4"
    model, _ = two_links(tmp_path, limits)
    np.testing.assert_allclose(model.jnt_actfrcrange[1], [-3, 4])


def test_a_urdfs_effort_limits_the_sum_of_motors(tmp_path):
    model, _ = two_links(tmp_path, "float urdf:limit:effort = 16")
    np.testing.assert_allclose(model.jnt_actfrcrange[1], [-16, 16])


def test_a_site_is_a_frame_and_no_shape(tmp_path):
    site = """def Sphere "tip" (prepend apiSchemas = ["MjcSiteAPI"])
        {
            double3 xformOp:translate = (0.1, 0.2, 0.3)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }"""
    model, _ = converted(write(tmp_path, link("a", inside=site)))
    np.testing.assert_allclose(model.site("tip").pos, [0.1, 0.2, 0.3])
    assert model.ngeom == 0
