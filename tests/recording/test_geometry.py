from __future__ import annotations

import mujoco
import numpy as np
import pytest

from wheelleg_exp.recording.writing.rerun_shapes import shape, weight, xyzw
from wheelleg_exp.rendering.scene_models import Kinematics, body_geoms, colour

HALF = np.sqrt(0.5)


def model(geoms: str, assets: str = "", world: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{assets}</asset><worldbody>{world}"
        f"<body name='b' pos='0 0 1'><freejoint/>{geoms}</body></worldbody></mujoco>"
    )


def numbers(archetype, component: str) -> np.ndarray:
    return np.array(getattr(archetype, component).as_arrow_array().to_pylist(), dtype=float)


def test_quaternions_are_reordered_from_wxyz_to_xyzw():
    np.testing.assert_array_equal(xyzw(np.array([[1.0, 2.0, 3.0, 4.0]])), [[2.0, 3.0, 4.0, 1.0]])


def test_box_keeps_half_sizes_place_and_orientation():
    m = model(f"<geom type='box' size='.1 .2 .3' pos='1 2 3' quat='{HALF} 0 0 {HALF}'/>")
    (box,) = shape(m, 0)
    np.testing.assert_allclose(numbers(box, "half_sizes"), [[0.1, 0.2, 0.3]], rtol=1e-6)
    np.testing.assert_allclose(numbers(box, "centers"), [[1, 2, 3]])
    np.testing.assert_allclose(numbers(box, "quaternions"), [[0, 0, HALF, HALF]], rtol=1e-6)


def test_capsule_begins_at_the_centre_of_a_cap():
    # From (0.1, 0, 0) to (0.1, 0.3, 0): rerun's origin is the first end, its z axis turned onto +y.
    m = model("<geom type='capsule' size='.05' fromto='.1 0 0 .1 .3 0'/>")
    (capsule,) = shape(m, 0)
    np.testing.assert_allclose(numbers(capsule, "lengths"), [0.3], rtol=1e-6)
    np.testing.assert_allclose(numbers(capsule, "radii"), [0.05], rtol=1e-6)
    x, y, z, w = numbers(capsule, "quaternions")[0]
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    origin = numbers(capsule, "translations")[0]
    ends = sorted([tuple(np.round(origin, 6)), tuple(np.round(origin + 0.3 * axis, 6))])
    np.testing.assert_allclose(ends, [(0.1, 0, 0), (0.1, 0.3, 0)], atol=1e-6)


def test_upright_capsule_is_shifted_down_by_half_its_length():
    m = model("<geom type='capsule' size='.05 .2' pos='0 0 1'/>")
    np.testing.assert_allclose(numbers(shape(m, 0)[0], "translations"), [[0, 0, 0.8]], rtol=1e-6)


def test_cylinder_has_its_full_length_and_stays_centred():
    m = model("<geom type='cylinder' size='.05 .2' pos='0 0 1'/>")
    (cylinder,) = shape(m, 0)
    np.testing.assert_allclose(numbers(cylinder, "lengths"), [0.4], rtol=1e-6)
    np.testing.assert_allclose(numbers(cylinder, "centers"), [[0, 0, 1]])


def test_sphere_and_ellipsoid_have_half_sizes():
    m = model("<geom type='sphere' size='.1'/><geom type='ellipsoid' size='.1 .2 .3'/>")
    np.testing.assert_allclose(numbers(shape(m, 0)[0], "half_sizes"), [[0.1] * 3], rtol=1e-6)
    np.testing.assert_allclose(numbers(shape(m, 1)[0], "half_sizes"), [[0.1, 0.2, 0.3]], rtol=1e-6)


def test_mesh_lands_where_it_was_modelled():
    # MuJoCo moves a mesh into its inertial frame; the drawn corners must be the authored ones again.
    corners = np.array([[0.5, 0, 0], [0.7, 0, 0], [0.5, 0.3, 0], [0.5, 0, 0.1]])
    text = " ".join(str(v) for v in corners.ravel())
    m = model("<geom type='mesh' mesh='m'/>", assets=f"<mesh name='m' vertex='{text}'/>")
    mesh, pose = shape(m, 0)
    x, y, z, w = numbers(pose, "quaternions")[0]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.array([w, x, y, z]))
    placed = numbers(mesh, "vertex_positions") @ rotation.reshape(3, 3).T + numbers(pose, "translations")
    found = np.unique(np.round(placed, 5), axis=0)
    np.testing.assert_allclose(found, np.unique(corners, axis=0), atol=1e-5)


def test_mesh_normals_point_outwards():
    corners = "0 0 0 1 0 0 0 1 0 0 0 1"
    m = model("<geom type='mesh' mesh='m'/>", assets=f"<mesh name='m' vertex='{corners}'/>")
    mesh = shape(m, 0)[0]
    vertices, normals = numbers(mesh, "vertex_positions"), numbers(mesh, "vertex_normals")
    assert ((vertices - vertices.mean(axis=0)) * normals).sum(axis=1).min() > 0


def test_height_field_is_drawn_where_rays_hit_it():
    field = "<hfield name='h' nrow='3' ncol='4' size='1 2 .5 .1' elevation='0 3 1 0 0 1 2 0 1 0 0 4'/>"
    m = model("<geom size='.01'/>", assets=field, world="<geom type='hfield' hfield='h'/>")
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    mesh = shape(m, 0)[0]
    for x, y, z in numbers(mesh, "vertex_positions"):
        # Slightly inside, because a ray through a border may pass by.
        start = np.array([0.9999 * x, 0.9999 * y, 5.0])
        distance = mujoco.mj_ray(m, data, start, np.array([0, 0, -1.0]), None, 1, -1, np.zeros(1, np.int32))
        assert 5.0 - distance == pytest.approx(z, abs=1e-3)
    assert numbers(mesh, "vertex_normals")[:, 2].min() > 0


def test_colour_is_the_materials_unless_the_geom_has_its_own():
    m = model(
        "<geom size='.1' material='red'/><geom size='.1' material='red' rgba='0 1 0 .5'/><geom size='.1'/>",
        assets="<material name='red' rgba='1 0 0 1'/>",
    )
    assert [colour(m, g).tolist() for g in range(3)] == [[255, 0, 0, 255], [0, 255, 0, 128], [128, 128, 128, 255]]


def test_visual_geoms_are_drawn_and_colliders_stand_apart():
    visual = "<geom size='.1' group='2' contype='0' conaffinity='0'/>"
    m = model(f"{visual}<geom size='.1'/>")
    assert body_geoms(m, 1) == ([0], [1])


def test_a_body_without_visual_geoms_is_drawn_by_its_colliders():
    m = model("<geom size='.1'/>", world="<geom type='plane' size='1 1 1'/>")
    assert body_geoms(m, 1) == ([1], [])
    assert body_geoms(m, 0) == ([], []), "a plane is no shape"
    assert shape(m, 0) == []


def test_height_and_weight_of_a_robot_give_the_scale_of_arrows():
    m = model("<geom size='.1' mass='2'/><body pos='0 0 .5'><geom size='.1' mass='1'/></body>")
    assert Kinematics(m).height(1, m.qpos0) == pytest.approx(0.7)
    assert weight(m, 1) == pytest.approx(3 * 9.81)
