"""The rules of reading USD physics, one small file each, held against what MuJoCo compiles."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from .small_usd import DEGREES, MASS, converted, hinge, link, tensor, two_links, write

CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    kilogramsPerUnit = 0.001\n    upAxis = "Y"'
CUBE = """
        def Cube "cube" (
            prepend apiSchemas = ["PhysicsCollisionAPI"{apis}]
        )
        {{
            double size = {size}
            {more}
        }}
"""


def cube(size: float = 0.2, *, apis: str = "", more: str = "") -> str:
    extra = "".join(f', "{api}"' for api in apis.split())
    return CUBE.format(size=size, apis=extra, more=more)


def solid_geoms(model: mujoco.MjModel) -> list[int]:
    return [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]


# ------------------------------------------------------------------ units and axes
def test_centimetres_and_grams_become_metres_and_kilograms(tmp_path):
    mass = "float physics:mass = 500\n        float3 physics:diagonalInertia = (2000, 3000, 4000)"
    model, _ = converted(write(tmp_path, link("a", "(0, 30, 0)", mass=mass, inside=cube(10)), header=CM))
    body = model.body("a")
    assert body.mass[0] == pytest.approx(0.5)
    np.testing.assert_allclose(tensor(model, "a"), np.diag([2e-4, 3e-4, 4e-4]), atol=1e-15)
    np.testing.assert_allclose(model.geom_size[solid_geoms(model)[0]], [0.05] * 3)


def test_y_up_is_turned_to_z_up_and_body_frames_turn_along(tmp_path):
    model, _ = converted(write(tmp_path, link("a", "(0, 30, 0)"), header=CM))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("a").xpos, [0, 0, 0.3], atol=1e-12)
    np.testing.assert_allclose(data.body("a").xmat.reshape(3, 3) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81])


def test_default_density_is_that_of_water_in_any_unit(tmp_path):
    model, _ = converted(write(tmp_path, link("a", mass="", inside=cube(10)), header=CM))
    assert model.body("a").mass[0] == pytest.approx(1000 * 0.1**3)


def test_gravity_is_in_stage_lengths(tmp_path):
    scene = 'def PhysicsScene "scene"\n{\n    float physics:gravityMagnitude = 162\n}'
    model, _ = converted(write(tmp_path, link("a"), header=CM, outside=scene))
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -1.62], rtol=1e-6)


def test_unset_units_are_usds_fallbacks_and_are_reported(tmp_path):
    model, done = converted(write(tmp_path, link("a", "(0, 30, 0)"), header='defaultPrim = "bot"'))
    assert model.body("a").pos[2] == pytest.approx(0.3)
    assert {"no metersPerUnit: USD's fallback", "no upAxis: USD's fallback"} <= {
        item.rule for item in done.report.assumptions
    }


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
    text = (
        f"float drive:angular:physics:stiffness = {kp}\n float drive:angular:physics:damping = {kd}\n"
        "float drive:angular:physics:maxForce = 7"
    )
    model, _ = two_links(tmp_path, text, apis="PhysicsDriveAPI:angular")
    drive = model.actuator("j")
    assert drive.gainprm[0] == pytest.approx(gain, rel=1e-6)
    np.testing.assert_allclose(drive.biasprm[:3], bias, rtol=1e-6)
    np.testing.assert_allclose(drive.forcerange, [-7, 7])


def test_linear_gains_are_per_length(tmp_path):
    text = "float drive:linear:physics:stiffness = 2\n float drive:linear:physics:damping = 0.5"
    model, _ = two_links(tmp_path, text, apis="PhysicsDriveAPI:linear", kind="Prismatic")
    np.testing.assert_allclose(model.actuator("j").biasprm[:3], [0, -2, -0.5])


@pytest.mark.parametrize("force", ["0", "inf", "3.4028235e38"])
def test_no_effort_limit_where_none_is_given(tmp_path, force):
    text = f"float drive:angular:physics:stiffness = 1\n float drive:angular:physics:maxForce = {force}"
    model, _ = two_links(tmp_path, text, apis="PhysicsDriveAPI:angular")
    assert not model.actuator_forcelimited[0]


def test_acceleration_gains_are_times_the_inertia_that_the_drive_meets(tmp_path):
    text = (
        "float drive:angular:physics:stiffness = 1\n"
        'uniform token drive:angular:physics:type = "acceleration"\n uniform token physics:axis = "X"'
    )
    model, _ = two_links(tmp_path, text, apis="PhysicsDriveAPI:angular", base="fixed")
    assert model.actuator("j").gainprm[0] == pytest.approx(DEGREES * 0.1, rel=1e-6)  # 0.1 kg m² about x


def test_targets_and_saved_state_become_the_home_keyframe(tmp_path):
    text = (
        "float drive:angular:physics:stiffness = 1\n float drive:angular:physics:targetPosition = 90\n"
        "float state:angular:physics:position = 30\n float state:angular:physics:velocity = 60"
    )
    model, _ = two_links(tmp_path, text, apis="PhysicsDriveAPI:angular PhysicsJointStateAPI:angular")
    key = model.key("home")
    assert key.qpos[-1] == pytest.approx(math.radians(30))
    assert key.qvel[-1] == pytest.approx(math.radians(60))
    assert key.ctrl[0] == pytest.approx(math.radians(90))


def test_a_saved_state_beyond_the_limits_is_clamped_and_reported(tmp_path):
    text = "float physics:lowerLimit = -10\n float physics:upperLimit = 10\nfloat state:angular:physics:position = 30"
    model, done = two_links(tmp_path, text, apis="PhysicsJointStateAPI:angular")
    assert model.key("home").qpos[-1] == pytest.approx(math.radians(10))
    assert any("outside the limits" in item.rule for item in done.report.assumptions)


def test_attributes_of_schemas_that_usd_does_not_know_are_read(tmp_path):
    text = "float physxJoint:armature = 0.25\n float physxJoint:maxJointVelocity = 180"
    model, done = two_links(tmp_path, text, apis="PhysxJointAPI")
    assert model.dof_armature[6] == pytest.approx(0.25)
    assert done.report.velocity_limits["j"] == pytest.approx(math.pi, rel=1e-6)


def test_newton_damping_is_per_degree_and_mujocos_is_per_radian(tmp_path):
    model, _ = two_links(tmp_path, "float newton:damping = 0.01")
    assert model.dof_damping[6] == pytest.approx(0.01 * DEGREES, rel=1e-6)
    model, _ = two_links(tmp_path, "float newton:damping = 0.01\n float mjc:damping = 0.5")
    assert model.dof_damping[6] == pytest.approx(0.5)


# ------------------------------------------------------------------ limits
@pytest.mark.parametrize(
    "limits",
    [
        ("-inf", "inf"),
        ("-57295776", "57295776"),
        ("-99999990", "99999990"),
        ("-1e38", "1e38"),
        ("0", "0"),
        ("-10", "inf"),
        None,
    ],
)
def test_a_hinge_without_real_limits_has_none(tmp_path, limits):
    text = f"float physics:lowerLimit = {limits[0]}\n float physics:upperLimit = {limits[1]}" if limits else ""
    model, _ = two_links(tmp_path, text)
    assert not model.jnt_limited[1]


def test_equal_limits_are_warned_about(tmp_path):
    _, done = two_links(tmp_path, "float physics:lowerLimit = 0\n float physics:upperLimit = 0")
    assert any("/bot/j" in warning and "PhysX locks" in warning for warning in done.report.warnings)


def test_a_slide_may_be_limited_on_one_side(tmp_path):
    model, _ = two_links(tmp_path, "float physics:lowerLimit = -0.5", kind="Prismatic")
    assert model.jnt_limited[1]
    assert model.jnt_range[1][0] == pytest.approx(-0.5)
    assert model.jnt_range[1][1] > 1e3


# ------------------------------------------------------------------ joints and the tree
@pytest.mark.parametrize(("token", "axis"), [("X", [1, 0, 0]), ("Y", [0, 1, 0]), ("Z", [0, 0, 1]), ("", [1, 0, 0])])
def test_axis_tokens(tmp_path, token, axis):
    model, _ = two_links(tmp_path, f'uniform token physics:axis = "{token}"')
    np.testing.assert_allclose(model.jnt_axis[1], axis)


def test_the_axis_is_turned_by_the_joint_frame_of_the_child(tmp_path):
    turned = "(0.70710678, 0, 0, 0.70710678)"  # 90° about z carries x to y
    model, _ = two_links(tmp_path, f"quatf physics:localRot0 = {turned}\n quatf physics:localRot1 = {turned}")
    np.testing.assert_allclose(model.jnt_axis[1], [0, 1, 0], atol=1e-6)


def test_a_joint_that_names_the_child_first_turns_the_other_way(tmp_path):
    """Coordinate = rotation of body1 against body0: the child, body0, turns by -q about the joint's axis."""
    text = (
        'uniform token physics:axis = "Z"\n point3f physics:localPos1 = (1, 0, 0)\n'
        "float physics:lowerLimit = -10\n float physics:upperLimit = 40"
    )
    body = link("a", apis="PhysicsArticulationRootAPI") + link("b", "(1, 0, 0)") + hinge("j", "b", "a", text=text)
    model, done = converted(write(tmp_path, body))
    assert model.body("b").parentid[0] == model.body("a").id
    np.testing.assert_allclose(model.jnt_range[1], np.radians([-10, 40]), rtol=1e-6)
    data = mujoco.MjData(model)
    data.joint("j").qpos = 0.3
    mujoco.mj_kinematics(model, data)
    x_axis = data.body("b").xmat.reshape(3, 3)[:, 0]
    np.testing.assert_allclose(x_axis, [math.cos(0.3), -math.sin(0.3), 0], atol=1e-9)
    assert any("body0" in item.rule for item in done.report.assumptions)


def test_joint_frames_win_over_drawn_poses(tmp_path):
    text = "point3f physics:localPos0 = (0, 0, 1)\n point3f physics:localPos1 = (0, 0, -0.5)"
    body = link("a") + link("b", "(7, 7, 7)") + hinge("j", "a", "b", text=text)
    model, done = converted(write(tmp_path, body))
    np.testing.assert_allclose(model.body("b").pos, [0, 0, 1.5])
    np.testing.assert_allclose(model.jnt_pos[1], [0, 0, -0.5])
    assert any("the frames win" in item.rule for item in done.report.assumptions)


def test_a_drawn_bend_is_the_keyframe_and_not_the_zero(tmp_path):
    bent = link("b", "(1, 0, 0)").replace(
        'xformOpOrder = ["xformOp:translate"]',
        'xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]\n        double xformOp:rotateX = 40',
    )
    text = "point3f physics:localPos0 = (1, 0, 0)"
    model, _ = converted(write(tmp_path, link("a") + bent + hinge("j", "a", "b", text=text)))
    np.testing.assert_allclose(model.body("b").quat, [1, 0, 0, 0], atol=1e-9)
    assert model.key("home").qpos[-1] == pytest.approx(math.radians(40), rel=1e-6)


def test_local_positions_are_stretched_by_the_bodys_scale(tmp_path):
    scaled = link("a").replace(
        'xformOpOrder = ["xformOp:translate"]',
        'xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n        double3 xformOp:scale = (2, 3, 4)',
    )
    text = "point3f physics:localPos0 = (1, 1, 1)"
    model, _ = converted(write(tmp_path, scaled + link("b", "(2, 3, 4)") + hinge("j", "a", "b", text=text)))
    np.testing.assert_allclose(model.body("b").pos, [2, 3, 4])


def test_a_spherical_joint_becomes_a_ball_with_the_smaller_cone(tmp_path):
    text = "float physics:coneAngle0Limit = 30\n float physics:coneAngle1Limit = 40"
    model, done = two_links(tmp_path, text, kind="Spherical")
    assert model.jnt_type[1] == mujoco.mjtJoint.mjJNT_BALL
    assert model.jnt_range[1][1] == pytest.approx(math.radians(30))
    assert any("cone angles" in warning for warning in done.report.warnings)


def test_a_fixed_joint_keeps_both_bodies(tmp_path):
    model, _ = two_links(tmp_path, kind="Fixed")
    assert model.nv == 6
    assert model.body("b").parentid[0] == model.body("a").id


def test_a_generic_joint_leaves_free_what_is_not_locked(tmp_path):
    lock = "\n".join(
        f"float limit:{axis}:physics:low = 1\n float limit:{axis}:physics:high = -1"
        for axis in ("transX", "transY", "transZ", "rotX")
    )
    ranged = "float limit:rotY:physics:low = -20\n float limit:rotY:physics:high = 30"
    apis = " ".join(f"PhysicsLimitAPI:{a}" for a in ("transX", "transY", "transZ", "rotX", "rotY"))
    model, _ = two_links(tmp_path, f"{lock}\n{ranged}", apis=apis, kind="")
    assert [model.joint(i).name for i in (1, 2)] == ["j_rotY", "j_rotZ"]
    np.testing.assert_allclose(model.jnt_range[1], np.radians([-20, 30]), rtol=1e-6)
    assert not model.jnt_limited[2]


def test_a_loop_is_closed_by_an_equality_on_the_hinges_axis(tmp_path):
    body = link("a") + link("b", "(1, 0, 0)") + link("c", "(0, 1, 0)")
    joints = (
        hinge("ab", "a", "b", text="point3f physics:localPos0 = (1, 0, 0)")
        + hinge("ac", "a", "c", text="point3f physics:localPos0 = (0, 1, 0)")
        + hinge("bc", "b", "c", text="point3f physics:localPos1 = (1, -1, 0)")
    )
    model, done = converted(write(tmp_path, body + joints))
    assert model.neq == 2
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos[:6], 0, atol=1e-9)
    assert any("closes a loop" in warning for warning in done.report.warnings)


def test_a_joint_to_a_body_that_is_not_there_is_left_out_and_named(tmp_path):
    model, done = converted(write(tmp_path, link("a") + link("b") + hinge("j", "a", "ghost")))
    assert model.njnt == 2  # both float
    assert any("/bot/j" in warning for warning in done.report.warnings)


def test_equal_leaf_names_get_their_parents_in_front(tmp_path):
    groups = "".join(f'def Xform "{side}"\n{{\n{link("arm")}\n}}\n' for side in ("left", "right"))
    model, _ = converted(write(tmp_path, groups + link("body")))
    names = {model.body(i).name for i in range(1, model.nbody)}
    assert names == {"left_arm", "right_arm", "body"}


# ------------------------------------------------------------------ the base
PIN = '\n    def PhysicsFixedJoint "root_joint"\n    {\n        rel physics:body1 = </bot/a>\n    }\n'


@pytest.mark.parametrize(
    ("pinned", "base", "floats"),
    [
        (False, "auto", True),
        (True, "auto", False),
        (True, "floating", True),
        (False, "fixed", False),
    ],
)
def test_base(tmp_path, pinned, base, floats):
    model, done = converted(write(tmp_path, link("a") + (PIN if pinned else "")), base=base)
    assert (model.nv == 6) is floats
    assert done.report.base == ("floating" if floats else "fixed")


# ------------------------------------------------------------------ mass
def test_a_mass_of_zero_means_not_given(tmp_path):
    zero = "float physics:mass = 0\n        float3 physics:diagonalInertia = (0, 0, 0)"
    model, done = converted(write(tmp_path, link("a", mass=zero, inside=cube(0.2))))
    assert model.body("a").mass[0] == pytest.approx(1000 * 0.2**3)
    np.testing.assert_allclose(tensor(model, "a"), np.eye(3) * 8 * 0.2**2 / 6, rtol=1e-6)
    assert any(item.name == "physics:mass" for item in done.report.left_out)


@pytest.mark.parametrize(
    ("body", "collider", "density"),
    [
        ("", "", 1000),
        ("float physics:density = 500", "", 500),
        ("float physics:density = 500", "float physics:density = 250", 250),
    ],
)
def test_the_colliders_density_wins_over_the_bodys(tmp_path, body, collider, density):
    inside = cube(0.2, apis="PhysicsMassAPI", more=collider)
    model, _ = converted(write(tmp_path, link("a", mass=body, inside=inside)))
    assert model.body("a").mass[0] == pytest.approx(density * 0.2**3, rel=1e-6)


def test_a_switched_off_collider_still_weighs(tmp_path):
    inside = cube(0.2, more="bool physics:collisionEnabled = 0")
    model, _ = converted(write(tmp_path, link("a", mass="", inside=inside)))
    assert model.body("a").mass[0] == pytest.approx(8.0)
    assert not solid_geoms(model)


def test_inertia_of_colliders_is_moved_to_an_authored_centre(tmp_path):
    mass = "float physics:mass = 2\n        point3f physics:centerOfMass = (0, 0, 0.5)"
    model, _ = converted(write(tmp_path, link("a", mass=mass, inside=cube(0.2))))
    own = 2 * 0.2**2 / 6
    expected = np.diag([own + 2 * 0.25, own + 2 * 0.25, own])
    np.testing.assert_allclose(tensor(model, "a"), expected, rtol=1e-6, atol=1e-12)


def test_principal_axes_turn_the_moments(tmp_path):
    mass = """float physics:mass = 1
        float3 physics:diagonalInertia = (0.1, 0.2, 0.25)
        quatf physics:principalAxes = (0.70710678, 0, 0, 0.70710678)"""
    model, _ = converted(write(tmp_path, link("a", mass=mass)))
    np.testing.assert_allclose(tensor(model, "a"), np.diag([0.2, 0.1, 0.25]), atol=1e-7)


def test_newtons_full_tensor_wins_over_the_diagonal(tmp_path):
    mass = MASS + "\n        float[] newton:inertia = [0.3, 0.2, 0.25, 0.01, 0, 0]"
    model, _ = converted(write(tmp_path, link("a", mass=mass)))
    np.testing.assert_allclose(tensor(model, "a")[:2, :2], [[0.3, 0.01], [0.01, 0.2]], rtol=1e-6)


def test_a_body_of_nothing_is_physx_ball_of_one_kilogram(tmp_path):
    model, _ = converted(write(tmp_path, link("a", mass="")))
    assert model.body("a").mass[0] == pytest.approx(1.0)
    np.testing.assert_allclose(tensor(model, "a"), np.eye(3) * 0.4 * 0.1**2)


# ------------------------------------------------------------------ colliders
def test_collision_api_on_an_instanced_xform_reaches_the_shapes_below(tmp_path):
    inside = """def Xform "collisions" (
            prepend apiSchemas = ["PhysicsCollisionAPI"]
            instanceable = true
            prepend references = </shapes>
        )
        {
        }"""
    prototype = """def Xform "shapes"
{
    def Xform "deeper"
    {
        double3 xformOp:scale = (0.1, 0.2, 0.3)
        uniform token[] xformOpOrder = ["xformOp:scale"]

        def Cube "box"
        {
            double size = 1
        }
    }
}"""
    model, _ = converted(write(tmp_path, link("a", inside=inside), outside=prototype))
    (geom,) = solid_geoms(model)  # and none for the prototype at the stage's root
    np.testing.assert_allclose(model.geom_size[geom], [0.05, 0.1, 0.15])
    assert model.ngeom == 1


def test_scaled_shapes(tmp_path):
    def shape(kind: str, attributes: str, scale: str) -> str:
        return f"""def {kind} "{kind.lower()}" (prepend apiSchemas = ["PhysicsCollisionAPI"])
        {{
            {attributes}
            double3 xformOp:scale = {scale}
            uniform token[] xformOpOrder = ["xformOp:scale"]
        }}
"""

    inside = (
        shape("Sphere", "double radius = 0.1", "(2, 2, 2)")
        + shape("Cylinder", 'token axis = "Y"\n double radius = 0.1\n double height = 1', "(2, 3, 2)")
        + shape("Cube", "double size = 1", "(1, 2, 3)")
    )
    model, _ = converted(write(tmp_path, link("a", inside=inside)))
    np.testing.assert_allclose(model.geom("a_sphere").size[0], 0.2)
    np.testing.assert_allclose(model.geom("a_cylinder").size[:2], [0.2, 1.5])
    np.testing.assert_allclose(model.geom("a_cube").size, [0.5, 1.0, 1.5])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom("a_cylinder").quat)
    np.testing.assert_allclose(np.abs(turn.reshape(3, 3)[:, 2]), [0, 1, 0], atol=1e-9)


def test_a_ball_that_is_stretched_becomes_an_ellipsoid(tmp_path):
    inside = """def Sphere "ball" (prepend apiSchemas = ["PhysicsCollisionAPI"])
        {
            double3 xformOp:scale = (0.1, 0.2, 0.3)
            uniform token[] xformOpOrder = ["xformOp:scale"]
        }"""
    model, done = converted(write(tmp_path, link("a", inside=inside)))
    geom = model.geom("a_ball")
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    np.testing.assert_allclose(geom.size, [0.1, 0.2, 0.3])
    assert any("ellipsoid" in item.rule for item in done.report.assumptions)


def test_a_mesh_is_written_beside_the_model(tmp_path):
    inside = """def Mesh "tetra" (
            prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]
        )
        {
            point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
            int[] faceVertexCounts = [3, 3, 3, 3]
            int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]
            uniform token physics:approximation = "convexHull"
        }"""
    model, done = converted(write(tmp_path, link("a", mass="", inside=inside)))
    assert [p.name for p in (done.output.parent / "bot_meshes").iterdir()] == ["a_tetra.obj"]
    assert model.body("a").mass[0] == pytest.approx(1000 / 6, rel=1e-5)
    np.testing.assert_allclose(model.body("a").ipos, [0.25] * 3, atol=1e-5)


def test_a_flat_static_mesh_becomes_a_thin_box(tmp_path):
    ground = """def Mesh "ground" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {
        point3f[] points = [(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
    }"""
    model, _ = converted(write(tmp_path, link("a") + ground))
    np.testing.assert_allclose(sorted(model.geom("world_ground").size)[1:], [5, 5], rtol=1e-6)


def test_friction_is_the_dynamic_one_and_the_rest_is_named(tmp_path):
    material = """
    def Material "rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"])
    {
        float physics:dynamicFriction = 0.7
        float physics:staticFriction = 0.9
        float physics:restitution = 0.1
    }
"""
    inside = cube(0.2, apis="MaterialBindingAPI", more="rel material:binding:physics = </bot/rubber>")
    model, done = converted(write(tmp_path, link("a", inside=inside) + material))
    assert model.geom_friction[solid_geoms(model)[0]][0] == pytest.approx(0.7)
    names = {item.name for item in done.report.left_out}
    assert {"physics:staticFriction", "physics:restitution"} <= names


# ------------------------------------------------------------------ contacts
def test_joined_bodies_do_not_touch_unless_the_joint_allows_it(tmp_path):
    for allowed, pairs in (("0", 1), ("1", 0)):
        model, _ = two_links(tmp_path, f"bool physics:collisionEnabled = {allowed}")
        assert model.nexclude == pairs


def test_without_self_collision_the_robot_still_touches_the_ground(tmp_path):
    root = "PhysicsArticulationRootAPI PhysxArticulationAPI"
    switch = "\n        bool physxArticulation:enabledSelfCollisions = 0\n"
    body = link("a", mass=MASS + switch, inside=cube(0.2), apis=root) + link("b", inside=cube(0.2))
    ground = 'def Plane "ground" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n token axis = "Z"\n}\n'
    model, _ = converted(write(tmp_path, body + ground))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)  # both cubes are at the origin, half in the ground
    pairs = {frozenset(model.geom(g).name for g in contact.geom) for contact in data.contact}
    assert pairs == {frozenset({"a_cube", "world_ground"}), frozenset({"b_cube", "world_ground"})}


def test_filtered_pairs_do_not_touch(tmp_path):
    filtered = MASS + "\n        rel physics:filteredPairs = </bot/b>"
    body = link("a", mass=filtered, inside=cube(0.2), apis="PhysicsFilteredPairsAPI")
    model, _ = converted(write(tmp_path, body + link("b", inside=cube(0.2))))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
