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


SHAPES = {
    f"type='box' size='.1 .2 .3' pos='1 2 3' quat='{HALF} 0 0 {HALF}'": {
        "half_sizes": [0.1, 0.2, 0.3], "centers": [1, 2, 3], "quaternions": [0, 0, HALF, HALF]},
    "type='capsule' size='.05 .2' pos='0 0 1'": {"lengths": [0.4], "translations": [0, 0, 0.8]},
    "type='cylinder' size='.05 .2' pos='0 0 1'": {"lengths": [0.4], "centers": [0, 0, 1]},
    "type='sphere' size='.1'": {"half_sizes": [0.1, 0.1, 0.1]},
    "type='ellipsoid' size='.1 .2 .3'": {"half_sizes": [0.1, 0.2, 0.3]},
}  # fmt: skip


@pytest.mark.parametrize("geom", SHAPES)
def test_a_shape_has_the_size_place_and_orientation_of_its_geom(geom):
    (found,) = shape(model(f"<geom {geom}/>"), 0)
    for component, expected in SHAPES[geom].items():
        np.testing.assert_allclose(np.ravel(numbers(found, component)), expected, rtol=1e-6)
    # Quaternions are reordered from wxyz to xyzw.
    np.testing.assert_array_equal(xyzw(np.array([[1.0, 2.0, 3.0, 4.0]])), [[2.0, 3.0, 4.0, 1.0]])


def test_capsule_begins_at_the_centre_of_a_cap():
    # The capsule reaches from (0.1, 0, 0) to (0.1, 0.3, 0). rerun's origin is the first end, and the z axis is rotated
    # to +y.
    m = model("<geom type='capsule' size='.05' fromto='.1 0 0 .1 .3 0'/>")
    (capsule,) = shape(m, 0)
    np.testing.assert_allclose(numbers(capsule, "lengths"), [0.3], rtol=1e-6)
    np.testing.assert_allclose(numbers(capsule, "radii"), [0.05], rtol=1e-6)
    x, y, z, w = numbers(capsule, "quaternions")[0]
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    origin = numbers(capsule, "translations")[0]
    ends = sorted([tuple(np.round(origin, 6)), tuple(np.round(origin + 0.3 * axis, 6))])
    np.testing.assert_allclose(ends, [(0.1, 0, 0), (0.1, 0.3, 0)], atol=1e-6)


def test_mesh_lands_where_it_was_modelled():
    # MuJoCo moves mesh vertices into the inertial frame; the recorded corners must equal the corners in the mesh file.
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
        # Each ray hits slightly inside the shape, because a ray through an edge can miss the shape.
        start = np.array([0.9999 * x, 0.9999 * y, 5.0])
        distance = mujoco.mj_ray(m, data, start, np.array([0, 0, -1.0]), None, 1, -1, np.zeros(1, np.int32))
        assert 5.0 - distance == pytest.approx(z, abs=1e-3)
    assert numbers(mesh, "vertex_normals")[:, 2].min() > 0


def test_colours_and_which_geoms_are_drawn():
    m = model(
        "<geom size='.1' material='red'/><geom size='.1' material='red' rgba='0 1 0 .5'/><geom size='.1'/>",
        assets="<material name='red' rgba='1 0 0 1'/>",
    )
    assert [colour(m, g).tolist() for g in range(3)] == [[255, 0, 0, 255], [0, 255, 0, 128], [128, 128, 128, 255]]
    visual = "<geom size='.1' group='2' contype='0' conaffinity='0'/>"
    m = model(f"{visual}<geom size='.1'/>")
    assert body_geoms(m, 1) == ([0], [1])
    m = model("<geom size='.1'/>", world="<geom type='plane' size='1 1 1'/>")
    assert body_geoms(m, 1) == ([1], [])
    assert body_geoms(m, 0) == ([], []), "a plane is no shape"
    assert shape(m, 0) == []


def test_height_and_weight_of_a_robot_give_the_scale_of_arrows():
    m = model("<geom size='.1' mass='2'/><body pos='0 0 .5'><geom size='.1' mass='1'/></body>")
    assert Kinematics(m).height(1, m.qpos0) == pytest.approx(0.7)
    assert weight(m, 1) == pytest.approx(3 * 9.81)
