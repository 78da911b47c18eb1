"""Rotations of whole tensors. Quaternions are (w, x, y, z); angles are radians.

In memory, the matrices (N, 3, 3) of ``quat_to_matrix`` are nine contiguous rows of N numbers, which is fast to process.
In memory, vectors (N, 3) and quaternions (N, 4) have torch's usual contiguous layout.
"""

from __future__ import annotations

from functools import cache

import torch

# ``_PRODUCTS_TO_MATRIX`` maps the 16 products q_a q_b of a unit quaternion's components to the rotation matrix.
_PRODUCTS_TO_MATRIX = torch.zeros(4, 4, 3, 3, device="cpu")
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

# ``_PRODUCTS_TO_QUAT`` maps the 16 products a_i b_j of the components of two quaternions a and b to their product a b.
_PRODUCTS_TO_QUAT = torch.zeros(4, 4, 4, device="cpu")
for _i, _row in enumerate(((0, 1, 2, 3), (1, -0, 3, -2), (2, -3, -0, 1), (3, 2, -1, -0))):
    for _j, _to in enumerate(_row):
        _negative = _to < 0 or (_to == 0 and _i > 0)
        _PRODUCTS_TO_QUAT[_i, _j, abs(_to)] = -1.0 if _negative else 1.0
_PRODUCTS_TO_QUAT = _PRODUCTS_TO_QUAT.reshape(16, 4)

# ``_HALF_ANGLES_TO_QUAT`` maps products of half-angle sines and cosines of roll, pitch, and yaw to a quaternion.
# In ``_HALF_ANGLES_TO_QUAT[roll, pitch, yaw]``, index 0 stands for a half angle's cosine, and index 1 for its sine.
_HALF_ANGLES_TO_QUAT = torch.zeros(2, 2, 2, 4, device="cpu")
for _indices, _to, _weight in (
    ((0, 0, 0), 0, 1.0), ((1, 1, 1), 0, 1.0),
    ((1, 0, 0), 1, 1.0), ((0, 1, 1), 1, -1.0),
    ((0, 1, 0), 2, 1.0), ((1, 0, 1), 2, 1.0),
    ((0, 0, 1), 3, 1.0), ((1, 1, 0), 3, -1.0),
):  # fmt: skip
    _HALF_ANGLES_TO_QUAT[(*_indices, _to)] = _weight
_HALF_ANGLES_TO_QUAT = _HALF_ANGLES_TO_QUAT.reshape(8, 4)


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
