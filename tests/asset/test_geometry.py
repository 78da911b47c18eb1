"""Rotations, polar decompositions, and solids equal those of MuJoCo and known matrix products."""

import mujoco
import numpy as np
import pytest

from wheelleg_exp.asset.rigid_geometry import (
    mesh_solid,
    primitive,
    quaternion,
    rotation_matrix,
    rounded,
    single,
    split_scale,
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_matrices_of_quaternions_are_mujocos(rng):
    for quat in rng.normal(size=(20, 4)):
        expected = np.zeros(9)
        mujoco.mju_quat2Mat(expected, quat / np.linalg.norm(quat))
        np.testing.assert_allclose(rotation_matrix(tuple(quat)), expected.reshape(3, 3), atol=1e-12)


def test_quaternions_of_matrices_are_mujocos(rng):
    half_turns = [(0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (1, 0, 0, 0)]
    for quat in [*rng.normal(size=(20, 4)), *np.array(half_turns, float)]:
        matrix = rotation_matrix(tuple(quat))
        np.testing.assert_allclose(rotation_matrix(quaternion(matrix)), matrix, atol=1e-11)
        assert quaternion(matrix)[0] >= 0


@pytest.mark.parametrize("value", [0.0425, -0.3, 1e-7, 3.0, 1718.8734])
def test_single_precision_reads_as_it_was_written(value):
    assert single(float(np.float32(value))) == value


@pytest.mark.parametrize("value", [-0.5, 1.7, 0.9599, -1.885, 3.0, 0.3])
def test_degrees_in_single_precision_become_the_radians_that_were_meant(value):
    degrees = float(np.float32(np.degrees(value)))
    assert rounded(np.radians(degrees)) == value


def test_rounding_stays_within_single_precision(rng):
    for value in rng.normal(size=200) * 10.0 ** rng.integers(-9, 9, size=200):
        assert abs(rounded(value) - value) <= abs(value) * 2**-23


@pytest.mark.parametrize("stretch", [(1.0, 2.0, 3.0), (1.0, 2.0, -3.0)], ids=["plain", "mirrored"])
def test_a_map_is_split_into_a_proper_rotation_and_a_stretch(rng, stretch):
    turn = rotation_matrix(tuple(rng.normal(size=4)))
    found_turn, found_stretch = split_scale(turn @ np.diag(stretch))
    assert np.linalg.det(found_turn) == pytest.approx(1.0)
    np.testing.assert_allclose(found_turn @ found_stretch, turn @ np.diag(stretch), atol=1e-12)
    if stretch[2] > 0:
        np.testing.assert_allclose(found_turn, turn, atol=1e-12)


# ------------------------------------------------------------------ solids


@pytest.mark.parametrize("size", [1e-3, 1.0, 50.0])
def test_a_hull_is_the_solid_of_its_points(size):
    half = np.array([0.1, 0.2, 0.3]) * size
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + size
    solid, box = mesh_solid(corners, None, "convex"), primitive("box", tuple(half))
    assert solid.volume == pytest.approx(box.volume, rel=1e-5)
    np.testing.assert_allclose(solid.center, [size] * 3, rtol=1e-5)
    np.testing.assert_allclose(solid.inertia, box.inertia, rtol=1e-4, atol=1e-4 * box.inertia.max())
