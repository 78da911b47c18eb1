"""Rotations of whole tensors. Quaternions are (w, x, y, z); angles are radians.

The matrices (N, 3, 3) of ``quat_to_matrix`` are nine contiguous rows of N numbers in memory, which is faster.
"""

from __future__ import annotations

from functools import cache

import torch

# ``_UNITS[a, b]`` is the product of the units a and b of (1, i, j, k) as a quaternion: i j = k, j k = i, k i = j.
_UNITS = torch.zeros(4, 4, 4, device="cpu")
_UNITS[0, 0, 0] = 1.0
for _a, _b, _c in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
    _UNITS[_a, _b, _c], _UNITS[_b, _a, _c] = 1.0, -1.0  # The units i, j, and k anticommute: j i = -k.
    _UNITS[_a, _a, 0] = -1.0  # The square of i, j, or k is -1.
    _UNITS[0, _a, _a] = _UNITS[_a, 0, _a] = 1.0
# Each table maps products of components, flattened to one index, to a result.
# The Hamilton product a b is the sum of a_i b_j times the product of the units i and j.
_PRODUCTS_TO_QUAT = _UNITS.reshape(16, 4)
# A unit quaternion q with the conjugate q* rotates v to q v q*, which is linear in the 16 products q_a q_b. Because
# q_a q_b = q_b q_a, the sum of both factors belongs to a < b, so that a sum of two terms gives each matrix element.
_CONJUGATE = torch.tensor([1.0, -1.0, -1.0, -1.0], device="cpu")
_ONCE = torch.ones(4, 4, device="cpu").triu() - torch.eye(4, device="cpu") / 2
_ROTATED = torch.einsum("ajk,kbi,b->abij", _UNITS[:, 1:], _UNITS[:, :, 1:], _CONJUGATE)
_PRODUCTS_TO_MATRIX = torch.einsum("abij,ab->abij", _ROTATED + _ROTATED.transpose(0, 1), _ONCE).reshape(16, 9) + 0.0
# Rz(yaw) Ry(pitch) Rx(roll) is the product of cos + k sin, cos + j sin, and cos + i sin of the half angles. In
# ``_HALF_ANGLES_TO_QUAT``, the index 0 of roll, pitch, or yaw stands for the cosine, and 1 for the sine.
_HALF_ANGLES_TO_QUAT = torch.einsum("ypk,krc->rpyc", _UNITS[::3, ::2], _UNITS[:, :2]).reshape(8, 4) + 0.0


@cache
def _on(table: torch.Tensor, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    return table.to(device, dtype)


def quat_to_matrix(q: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrices (N, 3, 3) of unit quaternions (N, 4)."""
    parts, table, n = q.T.contiguous(), _on(_PRODUCTS_TO_MATRIX, q.dtype, q.device), q.shape[0]
    products = (parts.unsqueeze(1) * parts.unsqueeze(0)).view(16, n)
    # Matrix-vector products (n = 1) add numbers in another order than matrix products, so results differ slightly.
    if n == 1:
        return (products.T @ table).view(1, 3, 3)
    return (table.T @ products).view(3, 3, n).permute(2, 0, 1)


def rotate(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return the rotated vectors R v (N, 3), for matrices R (N, 3, 3) and vectors v (N, 3)."""
    return (matrix.permute(1, 2, 0) * vector.T.unsqueeze(0)).sum(dim=1).T.contiguous()


def rotate_inverse(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return the inversely rotated vectors R^T v (N, 3), for matrices R (N, 3, 3) and vectors v (N, 3)."""
    return (matrix.permute(1, 2, 0) * vector.T.unsqueeze(1)).sum(dim=0).T.contiguous()


def quat_mul(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the Hamilton product of quaternions (n, 4)."""
    products = (a.unsqueeze(2) * b.unsqueeze(1)).flatten(1)
    return products @ _on(_PRODUCTS_TO_QUAT, products.dtype, products.device)


def quat_from_euler_xyz(roll: torch.Tensor, pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternions (n, 4) of the rotations Rz(yaw) Ry(pitch) Rx(roll) for three angles (n,), rad."""
    half = torch.stack((roll, pitch, yaw), dim=1) / 2
    roll, pitch, yaw = torch.stack((half.cos(), half.sin()), dim=2).unbind(dim=1)
    products = (roll.unsqueeze(2) * pitch.unsqueeze(1)).unsqueeze(3) * yaw.view(-1, 1, 1, 2)
    return products.flatten(1) @ _on(_HALF_ANGLES_TO_QUAT, products.dtype, products.device)


def random_quat(count: int, generator: torch.Generator) -> torch.Tensor:
    """Return quaternions (count, 4) uniform on SO(3): normalised 4-d Gaussians (Marsaglia 1972)."""
    return torch.nn.functional.normalize(torch.randn(count, 4, generator=generator, device=generator.device), dim=-1)


def wrap_to_pi(angles: torch.Tensor) -> torch.Tensor:
    """Wrap angles to [-pi, pi]; odd multiples of pi keep their sign (3 pi becomes +pi), as in Isaac Lab."""
    wrapped = (angles + torch.pi) % (2 * torch.pi)
    return torch.where((wrapped == 0) & (angles > 0), torch.pi, wrapped - torch.pi)


def uniform(low: torch.Tensor, high: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    """Return uniform random numbers (count, k) within the bounds ``low`` and ``high``, (k,)."""
    return low + (high - low) * torch.rand(count, low.shape[0], generator=generator, device=low.device)
