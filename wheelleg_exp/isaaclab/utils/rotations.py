"""Quaternions (w, x, y, z), Euler angles, rotation matrices and vectors; tensors may have any leading dimensions."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch

from wheelleg_exp.sim import rotation

SMALL = 1e-6  # an angle below which its sine is taken for itself


def cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return cross products of vectors whose leading dimensions broadcast."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def normalize(x: torch.Tensor, eps: float = 1e-9) -> torch.Tensor:
    """Return vectors of length 1; those shorter than ``eps`` are divided by it."""
    return torch.nn.functional.normalize(x, dim=-1, eps=eps)


def quat_conjugate(q: torch.Tensor) -> torch.Tensor:
    """Return (w, -x, -y, -z)."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def quat_inv(q: torch.Tensor, eps: float = 1e-9) -> torch.Tensor:
    """Return the inverse: the conjugate over the squared norm, which is taken for at least ``eps``."""
    return quat_conjugate(q) / q.square().sum(dim=-1, keepdim=True).clamp(min=eps)


def quat_mul(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the Hamilton product; ``q2`` turns first.

    Raises:
        ValueError: the shapes differ.
    """
    if q1.shape != q2.shape:
        raise ValueError(f"quaternions of shapes {tuple(q1.shape)} and {tuple(q2.shape)} cannot be multiplied")
    return rotation.quat_mul(q1.reshape(-1, 4), q2.reshape(-1, 4)).view(q1.shape)


def quat_unique(q: torch.Tensor) -> torch.Tensor:
    """Return the same rotations with w >= 0."""
    return torch.where(q[..., :1] < 0.0, -q, q)


def quat_apply(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors."""
    w, axis = quat[..., :1], quat[..., 1:]
    turn = 2.0 * cross(axis, vec)
    return vec + w * turn + cross(axis, turn)


def quat_apply_inverse(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors back."""
    return quat_apply(quat_conjugate(quat), vec)


quat_rotate = quat_apply
quat_rotate_inverse = quat_apply_inverse


def yaw_quat(quat: torch.Tensor) -> torch.Tensor:
    """Return the rotations about z by the yaw alone."""
    w, x, y, z = quat.unbind(dim=-1)
    half = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) / 2.0
    none = torch.zeros_like(half)
    return normalize(torch.stack((half.cos(), none, none, half.sin()), dim=-1))


def quat_apply_yaw(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors by the yaw alone."""
    return quat_apply(yaw_quat(quat), vec)


def quat_from_angle_axis(angle: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return rotations by angles (...) about axes (..., 3) of any length."""
    half = angle.unsqueeze(-1) / 2.0
    return normalize(torch.cat((half.cos(), normalize(axis) * half.sin()), dim=-1))


def axis_angle_from_quat(quat: torch.Tensor, eps: float = SMALL) -> torch.Tensor:
    """Return the rotation vectors (..., 3) of length at most pi."""
    quat = quat_unique(quat)
    sine = torch.linalg.vector_norm(quat[..., 1:], dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, quat[..., :1])
    # sin(a / 2) / a is 1/2 - a^2 / 48 + ...
    per_angle = torch.where(angle > eps, sine / angle.clamp(min=eps), 0.5 - angle.square() / 48.0)
    return quat[..., 1:] / per_angle


def quat_box_minus(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the rotation vector (..., 3) that takes ``q2`` to ``q1``, world axes."""
    return axis_angle_from_quat(quat_mul(q1, quat_conjugate(q2)))


def quat_box_plus(q: torch.Tensor, delta: torch.Tensor, eps: float = SMALL) -> torch.Tensor:
    """Turn rotations by rotation vectors (..., 3), world axes; w >= 0."""
    angle = torch.linalg.vector_norm(delta, dim=-1, keepdim=True).clamp(min=eps)
    half = angle / 2.0
    turn = torch.cat((half.cos(), delta / angle * half.sin()), dim=-1)
    return quat_unique(quat_mul(turn, q))


def quat_error_magnitude(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the angle between rotations, (...)."""
    return torch.linalg.vector_norm(quat_box_minus(q1, q2), dim=-1)


def quat_slerp(q1: torch.Tensor, q2: torch.Tensor, tau: float) -> torch.Tensor:
    """Return the rotation (4,) a share ``tau`` of the shorter way from ``q1`` to ``q2``, (4,) (Shoemake 1985)."""
    cosine = (q1 * q2).sum()
    q2, cosine = torch.where(cosine < 0.0, -q2, q2), cosine.abs().clamp(max=1.0)
    angle = torch.acos(cosine)
    straight = normalize(torch.lerp(q1, q2, tau))
    bent = (torch.sin((1.0 - tau) * angle) * q1 + torch.sin(tau * angle) * q2) / torch.sin(angle).clamp(min=1e-12)
    return torch.where(angle < 1e-4, straight, bent)


def convert_quat(quat: Any, to: Literal["xyzw", "wxyz"] = "xyzw") -> Any:
    """Return quaternions, tensors or arrays, in the other order of components.

    Raises:
        ValueError: no quaternions, or no order.
    """
    if quat.shape[-1] != 4 or to not in ("xyzw", "wxyz"):
        raise ValueError(f"expected quaternions (..., 4) and to='xyzw' or 'wxyz', not {tuple(quat.shape)} and {to!r}")
    shift = -1 if to == "xyzw" else 1
    return np.roll(quat, shift, axis=-1) if isinstance(quat, np.ndarray) else quat.roll(shift, dims=-1)


# --- Euler angles and matrices ---


def quat_from_euler_xyz(roll: torch.Tensor, pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return Rz(yaw) Ry(pitch) Rx(roll), (..., 4), for angles (...)."""
    quat = rotation.quat_from_euler_xyz(*(angle.reshape(-1) for angle in (roll, pitch, yaw)))
    return quat.view(*roll.shape, 4)


def euler_xyz_from_quat(
    quat: torch.Tensor, wrap_to_2pi: bool = False
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return roll, pitch and yaw (...), roll and yaw in [-pi, pi], or all in [0, 2 pi)."""
    w, x, y, z = quat.unbind(dim=-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if wrap_to_2pi:
        return roll % (2.0 * torch.pi), pitch % (2.0 * torch.pi), yaw % (2.0 * torch.pi)
    return roll, pitch, yaw


def matrix_from_quat(quaternions: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) of quaternions of any length but 0."""
    matrix = rotation.quat_to_matrix(normalize(quaternions).reshape(-1, 4))
    return matrix.view(*quaternions.shape[:-1], 3, 3)


def quat_from_matrix(matrix: torch.Tensor) -> torch.Tensor:
    """Return quaternions (..., 4) of rotation matrices, by the largest component (Shepperd 1978)."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x, y, z = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    # 4 q q^T, row by row: each row is the quaternion times four times its own component.
    rows = torch.stack(
        (
            torch.stack((1.0 + xx + yy + zz, x, y, z), dim=-1),
            torch.stack((x, 1.0 + xx - yy - zz, xy, xz), dim=-1),
            torch.stack((y, xy, 1.0 - xx + yy - zz, yz), dim=-1),
            torch.stack((z, xz, yz, 1.0 - xx - yy + zz), dim=-1),
        ),
        dim=-2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = rows.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    return normalize(row)


def matrix_from_euler(euler_angles: torch.Tensor, convention: str) -> torch.Tensor:
    """Return the product (..., 3, 3) of rotations by three angles (..., 3) about axes such as ``"XYZ"``."""
    turns = []
    for angle, axis in zip(euler_angles.unbind(dim=-1), convention, strict=True):
        unit = torch.zeros(3, dtype=angle.dtype, device=angle.device)
        unit["XYZ".index(axis)] = 1.0
        turns.append(matrix_from_quat(quat_from_angle_axis(angle, unit.expand(*angle.shape, 3))))
    return turns[0] @ turns[1] @ turns[2]


def skew_symmetric_matrix(vec: torch.Tensor) -> torch.Tensor:
    """Return the matrices (n, 3, 3) of cross products with vectors (n, 3) or (3,)."""
    vec = vec.reshape(-1, 3)
    return cross(vec.unsqueeze(-2), torch.eye(3, dtype=vec.dtype, device=vec.device)).mT
