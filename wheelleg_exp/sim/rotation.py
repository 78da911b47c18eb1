"""Rotations on whole tensors. Quaternions are (w, x, y, z); angles are radians."""

from __future__ import annotations

import torch

# R_ij as a linear map of the 16 products q_a q_b, (16, 9); rows are a*4+b (unit quaternions).
_PRODUCTS_TO_MATRIX = torch.zeros(4, 4, 3, 3)
for _i in range(3):
    for _j in range(3):
        if _i == _j:
            for _a, _sign in ((0, 1), (1, -1), (2, -1), (3, -1)):
                _PRODUCTS_TO_MATRIX[_a, _a, _i, _j] += _sign
            _PRODUCTS_TO_MATRIX[_i + 1, _i + 1, _i, _j] += 2
        else:
            _PRODUCTS_TO_MATRIX[_i + 1, _j + 1, _i, _j] += 2
            _third = 3 - _i - _j
            _PRODUCTS_TO_MATRIX[0, _third + 1, _i, _j] += -2 if (_j - _i) % 3 == 1 else 2
_PRODUCTS_TO_MATRIX = _PRODUCTS_TO_MATRIX.reshape(16, 9)


def quat_to_matrix(q: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrices (N, 3, 3) of unit quaternions (N, 4)."""
    products = (q.unsqueeze(2) * q.unsqueeze(1)).view(-1, 16)
    return (products @ _PRODUCTS_TO_MATRIX.to(q.dtype)).view(-1, 3, 3)


def rotate(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return R v for matrices (N, 3, 3) and vectors (N, 3)."""
    return torch.bmm(matrix, vector.unsqueeze(2)).squeeze(2)


def rotate_inverse(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return R^T v for matrices (N, 3, 3) and vectors (N, 3)."""
    return torch.bmm(vector.unsqueeze(1), matrix).squeeze(1)


def quat_mul(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the Hamilton product of quaternions (..., 4)."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def quat_from_euler_xyz(roll: torch.Tensor, pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternions (..., 4) of Rz(yaw) Ry(pitch) Rx(roll), the convention of Isaac Lab."""
    cr, sr = torch.cos(roll / 2), torch.sin(roll / 2)
    cp, sp = torch.cos(pitch / 2), torch.sin(pitch / 2)
    cy, sy = torch.cos(yaw / 2), torch.sin(yaw / 2)
    return torch.stack(
        (
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
        ),
        dim=-1,
    )


def random_quat(count: int, generator: torch.Generator) -> torch.Tensor:
    """Return quaternions (count, 4) uniform on SO(3): normalised 4-d Gaussians (Marsaglia 1972)."""
    return torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)


def wrap_to_pi(angles: torch.Tensor) -> torch.Tensor:
    """Wrap angles to [-pi, pi]; positive odd multiples of pi give +pi, negative ones -pi, as in Isaac Lab."""
    wrapped = (angles + torch.pi) % (2 * torch.pi)
    return torch.where((wrapped == 0) & (angles > 0), torch.pi, wrapped - torch.pi)


def uniform(low: torch.Tensor, high: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    """Return U(low, high), (count, k), for bounds (k,)."""
    return low + (high - low) * torch.rand(count, low.shape[0], generator=generator)
