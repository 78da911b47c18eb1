"""Volumes and moments of inertia of solids equal those of MuJoCo's compiler."""

import mujoco
import numpy as np
import pytest

from wheelleg_exp.asset.rigid_geometry import Frame, mesh_solid, primitive, rotation_matrix

SHAPES = {
    "box": (0.1, 0.2, 0.3),
    "sphere": (0.2,),
    "ellipsoid": (0.1, 0.2, 0.3),
    "cylinder": (0.1, 0.3),
    "capsule": (0.1, 0.3),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_primitives(kind):
    size = SHAPES[kind]
    geom = f'<geom type="{kind}" size="{" ".join(map(str, size))}" density="1"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body>{geom}</body></worldbody></mujoco>")
    solid = primitive(kind, size)
    assert solid.volume == pytest.approx(model.body_mass[1], rel=1e-9)
    np.testing.assert_allclose(np.sort(np.diag(solid.inertia)), np.sort(model.body_inertia[1]), rtol=1e-9)


@pytest.mark.parametrize("size", [1e-3, 1.0, 50.0])
def test_a_hull_is_the_solid_of_its_points(size):
    half = np.array([0.1, 0.2, 0.3]) * size
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + size
    solid, box = mesh_solid(corners, None, "convex"), primitive("box", tuple(half))
    assert solid.volume == pytest.approx(box.volume, rel=1e-5)
    np.testing.assert_allclose(solid.center, [size] * 3, rtol=1e-5)
    np.testing.assert_allclose(solid.inertia, box.inertia, rtol=1e-4, atol=1e-4 * box.inertia.max())


def test_points_in_one_plane_have_no_solid():
    with pytest.raises(ValueError, match=r".*"):
        mesh_solid(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), None, "convex")


def test_a_turned_solid_has_turned_moments():
    turn = rotation_matrix((np.sqrt(0.5), 0, 0, np.sqrt(0.5)))  # 90° about z
    solid = primitive("box", (0.1, 0.2, 0.3)).seen_from(Frame(turn, np.array([1.0, 2, 3])))
    expected = primitive("box", (0.2, 0.1, 0.3))
    np.testing.assert_allclose(solid.inertia, expected.inertia, atol=1e-12)
    np.testing.assert_allclose(solid.center, [1, 2, 3])
