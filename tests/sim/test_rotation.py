import math

import mujoco
import numpy as np
import pytest
import torch

from wheelleg_exp.sim import rotation


@pytest.fixture
def quats() -> torch.Tensor:
    q = torch.randn(50, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return torch.nn.functional.normalize(q, dim=1)


def test_matrices_are_mujocos(quats):
    expected = np.zeros((50, 9))
    for row, quat in zip(expected, quats, strict=True):
        mujoco.mju_quat2Mat(row, quat.numpy())
    np.testing.assert_allclose(rotation.quat_to_matrix(quats), expected.reshape(50, 3, 3), atol=1e-14)
    assert rotation.quat_to_matrix(quats.float()).dtype == torch.float32


def test_rotating_and_rotating_back(quats):
    vectors = torch.randn(50, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    expected = np.zeros((50, 3))
    for row, q, v in zip(expected, quats, vectors, strict=True):
        mujoco.mju_rotVecQuat(row, v.numpy(), q.numpy())
    matrix = rotation.quat_to_matrix(quats)
    turned = rotation.rotate(matrix, vectors)
    np.testing.assert_allclose(turned, expected, atol=1e-14)
    np.testing.assert_allclose(rotation.rotate_inverse(matrix, turned), vectors, atol=1e-14)


def test_products_are_mujocos(quats):
    others = quats.flip(0)
    expected = np.zeros((50, 4))
    for row, a, b in zip(expected, quats, others, strict=True):
        mujoco.mju_mulQuat(row, a.numpy(), b.numpy())
    np.testing.assert_allclose(rotation.quat_mul(quats, others), expected, atol=1e-14)


def test_euler_angles_turn_about_x_then_y_then_z_of_the_world():
    roll, pitch, yaw = 0.3, -0.7, 1.9
    expected = np.zeros(4)
    mujoco.mju_euler2Quat(expected, np.array([roll, pitch, yaw]), "XYZ")  # extrinsic: Rz Ry Rx
    got = rotation.quat_from_euler_xyz(*(torch.tensor([a], dtype=torch.float64) for a in (roll, pitch, yaw)))
    np.testing.assert_allclose(got[0], expected, atol=1e-14)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        *((0.0, 0.0), (math.pi, math.pi), (-math.pi, -math.pi), (3 * math.pi, math.pi), (-3 * math.pi, -math.pi)),
        *((2 * math.pi, 0.0), (-2 * math.pi, 0.0), (math.pi + 0.1, -math.pi + 0.1)),
        *((-math.pi - 0.1, math.pi - 0.1), (7.0, 7.0 - 2 * math.pi)),
    ],
)
def test_wrapping_to_pi_preserves_the_sign_of_odd_multiples(angle, wrapped):
    assert float(rotation.wrap_to_pi(torch.tensor([angle], dtype=torch.float64))) == pytest.approx(wrapped, abs=1e-12)
