"""Each rule of reading USD physics gives the expected MuJoCo model for a small USD file."""

import math

import mujoco
import numpy as np
import pytest

from ..small_usd import converted, hinge, link, tensor, two_links, write

CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    kilogramsPerUnit = 0.001\n    upAxis = "Y"'


def cube(size: float) -> str:
    return f'def Cube "cube" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {{ double size = {size}; }}\n'


def solid_geoms(model: mujoco.MjModel) -> list[int]:
    return [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]


# ------------------------------------------------------------------ units and axes
def test_centimetres_and_grams_become_si_and_y_up_is_turned_to_z_up_with_the_body_frames(tmp_path):
    mass = "float physics:mass = 500\n        float3 physics:diagonalInertia = (2000, 3000, 4000)"
    model, _ = converted(write(tmp_path, link("a", "(0, 30, 0)", mass=mass, inside=cube(10)), header=CM))
    body = model.body("a")
    assert body.mass[0] == pytest.approx(0.5)
    np.testing.assert_allclose(tensor(model, "a"), np.diag([2e-4, 3e-4, 4e-4]), atol=1e-15)
    np.testing.assert_allclose(model.geom_size[solid_geoms(model)[0]], [0.05] * 3)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("a").xpos, [0, 0, 0.3], atol=1e-12)
    np.testing.assert_allclose(data.body("a").xmat.reshape(3, 3) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81])


def test_unset_units_are_usds_fallbacks_and_are_reported(tmp_path):
    model, done = converted(write(tmp_path, link("a", "(0, 30, 0)"), header='defaultPrim = "bot"'))
    assert model.body("a").pos[2] == pytest.approx(0.3)
    fallbacks = {"no metersPerUnit: USD's fallback", "no upAxis: USD's fallback"}
    assert fallbacks <= {item.rule for item in done.report.assumptions}


# ------------------------------------------------------------------ joints and the tree
@pytest.mark.parametrize(("token", "axis"), [("X", [1, 0, 0]), ("Y", [0, 1, 0]), ("Z", [0, 0, 1]), ("", [1, 0, 0])])
def test_axis_tokens(tmp_path, token, axis):
    model, _ = two_links(tmp_path, f'uniform token physics:axis = "{token}"')
    np.testing.assert_allclose(model.jnt_axis[1], axis)


def test_the_axis_is_turned_by_the_joint_frame_of_the_child(tmp_path):
    turned = "(0.70710678, 0, 0, 0.70710678)"  # 90° about z
    model, _ = two_links(tmp_path, f"quatf physics:localRot0 = {turned}\n quatf physics:localRot1 = {turned}")
    np.testing.assert_allclose(model.jnt_axis[1], [0, 1, 0], atol=1e-6)


def test_a_joint_that_names_the_child_first_turns_the_other_way(tmp_path):
    text = 'uniform token physics:axis = "Z"\n point3f physics:localPos1 = (1, 0, 0)\n'
    text += "float physics:lowerLimit = -10\n float physics:upperLimit = 40"
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
    model, done = converted(write(tmp_path, link("a") + link("b", "(7, 7, 7)") + hinge("j", "a", "b", text=text)))
    np.testing.assert_allclose(model.body("b").pos, [0, 0, 1.5])
    np.testing.assert_allclose(model.jnt_pos[1], [0, 0, -0.5])
    assert any("the frames win" in item.rule for item in done.report.assumptions)


def test_local_positions_are_stretched_by_the_bodys_scale(tmp_path):
    stretched = '["xformOp:translate", "xformOp:scale"]\n        double3 xformOp:scale = (2, 3, 4)'
    scaled = link("a").replace('["xformOp:translate"]', stretched)
    text = "point3f physics:localPos0 = (1, 1, 1)"
    model, _ = converted(write(tmp_path, scaled + link("b", "(2, 3, 4)") + hinge("j", "a", "b", text=text)))
    np.testing.assert_allclose(model.body("b").pos, [2, 3, 4])


def test_a_fixed_joint_does_not_merge_its_bodies(tmp_path):
    model, _ = two_links(tmp_path, kind="Fixed")
    assert (model.nv, model.body("b").parentid[0]) == (6, model.body("a").id)


def test_a_joint_to_a_body_that_is_not_there_is_left_out_and_named(tmp_path):
    model, done = converted(write(tmp_path, link("a") + link("b") + hinge("j", "a", "ghost")))
    assert model.njnt == 2  # both float
    assert any("/bot/j" in warning for warning in done.report.warnings)


def test_equal_leaf_names_get_their_parents_in_front(tmp_path):
    groups = "".join(f'def Xform "{side}"\n{{\n{link("arm")}\n}}\n' for side in ("left", "right"))
    model, _ = converted(write(tmp_path, groups + link("body")))
    assert {model.body(i).name for i in range(1, model.nbody)} == {"left_arm", "right_arm", "body"}


# ------------------------------------------------------------------ the base
PIN = '\n    def PhysicsFixedJoint "root_joint"\n    {\n        rel physics:body1 = </bot/a>\n    }\n'


@pytest.mark.parametrize(
    ("pinned", "base", "floats"),
    [(False, "auto", True), (True, "auto", False), (True, "floating", True), (False, "fixed", False)],
)
def test_base(tmp_path, pinned, base, floats):
    model, done = converted(write(tmp_path, link("a") + (PIN if pinned else "")), base=base)
    assert (model.nv == 6) is floats
    assert done.report.base == ("floating" if floats else "fixed")


# ------------------------------------------------------------------ colliders
def test_collision_api_on_an_instanced_xform_reaches_the_shapes_below(tmp_path):
    inside = """def Xform "collisions" (
            prepend apiSchemas = ["PhysicsCollisionAPI"]; instanceable = true; prepend references = </shapes>
        ) {}"""
    prototype = """def Xform "shapes" {
    def Xform "deeper" {
        double3 xformOp:scale = (0.1, 0.2, 0.3); uniform token[] xformOpOrder = ["xformOp:scale"]
        def Cube "box" { double size = 1; }
    }
}"""
    model, _ = converted(write(tmp_path, link("a", inside=inside), outside=prototype))
    (geom,) = solid_geoms(model)  # without the prototype
    np.testing.assert_allclose(model.geom_size[geom], [0.05, 0.1, 0.15])
    assert model.ngeom == 1


def scaled(kind: str, attributes: str, scale: str) -> str:
    head = f'def {kind} "{kind.lower()}" (prepend apiSchemas = ["PhysicsCollisionAPI"])'
    return f'{head} {{ {attributes}; double3 xformOp:scale = {scale}; token[] xformOpOrder = ["xformOp:scale"]; }}\n'


def test_scaled_shapes(tmp_path):
    cylinder = 'token axis = "Y"; double radius = 0.1; double height = 1'
    inside = scaled("Sphere", "double radius = 0.1", "(2, 2, 2)") + scaled("Cylinder", cylinder, "(2, 3, 2)")
    inside += scaled("Cube", "double size = 1", "(1, 2, 3)")
    inside += scaled("Sphere", "double radius = 1", "(0.1, 0.2, 0.3)").replace('"sphere"', '"stretched"')
    model, done = converted(write(tmp_path, link("a", inside=inside)))
    np.testing.assert_allclose(model.geom("a_sphere").size[0], 0.2)
    np.testing.assert_allclose(model.geom("a_cylinder").size[:2], [0.2, 1.5])
    np.testing.assert_allclose(model.geom("a_cube").size, [0.5, 1.0, 1.5])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom("a_cylinder").quat)
    np.testing.assert_allclose(np.abs(turn.reshape(3, 3)[:, 2]), [0, 1, 0], atol=1e-9)
    assert model.geom("a_stretched").type[0] == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    np.testing.assert_allclose(model.geom("a_stretched").size, [0.1, 0.2, 0.3])
    assert any("ellipsoid" in item.rule for item in done.report.assumptions)


def test_a_mesh_is_written_beside_the_model(tmp_path):
    inside = """def Mesh "tetra" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]) {
            point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]; int[] faceVertexCounts = [3, 3, 3, 3]
            int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]
            uniform token physics:approximation = "convexHull"
        }"""
    model, done = converted(write(tmp_path, link("a", mass="", inside=inside)))
    assert [p.name for p in (done.output.parent / "bot_meshes").iterdir()] == ["a_tetra.obj"]
    assert model.body("a").mass[0] == pytest.approx(1000 / 6, rel=1e-5)
    np.testing.assert_allclose(model.body("a").ipos, [0.25] * 3, atol=1e-5)


def test_a_flat_static_mesh_becomes_a_thin_box(tmp_path):
    ground = """def Mesh "ground" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {
        point3f[] points = [(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)]
        int[] faceVertexCounts = [4]; int[] faceVertexIndices = [0, 1, 2, 3]
    }"""
    model, _ = converted(write(tmp_path, link("a") + ground))
    np.testing.assert_allclose(sorted(model.geom("world_ground").size)[1:], [5, 5], rtol=1e-6)


# ------------------------------------------------------------------ contacts
def test_joined_bodies_do_not_touch_unless_the_joint_allows_it(tmp_path):
    for allowed, pairs in (("0", 1), ("1", 0)):
        model, _ = two_links(tmp_path, f"bool physics:collisionEnabled = {allowed}")
        assert model.nexclude == pairs
