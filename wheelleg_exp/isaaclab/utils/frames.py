"""Frames and poses, of positions and quaternions (w, x, y, z) and as matrices, with any leading dimensions."""

from __future__ import annotations

from typing import Literal

import torch

from wheelleg_exp.isaaclab.utils.rotations import (
    SMALL,
    axis_angle_from_quat,
    cross,
    quat_apply,
    quat_apply_inverse,
    quat_from_angle_axis,
    quat_inv,
    quat_mul,
)


def combine_frame_transforms(
    t01: torch.Tensor, q01: torch.Tensor, t12: torch.Tensor | None = None, q12: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return frame 2 in frame 0, of 1 in 0 and 2 in 1."""
    return t01 if t12 is None else t01 + quat_apply(q01, t12), q01 if q12 is None else quat_mul(q01, q12)


def subtract_frame_transforms(
    t01: torch.Tensor, q01: torch.Tensor, t02: torch.Tensor | None = None, q02: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return frame 2 in frame 1, of 1 in 0 and 2 in 0."""
    back = quat_inv(q01)
    return quat_apply(back, -t01 if t02 is None else t02 - t01), back if q02 is None else quat_mul(back, q02)


def rigid_body_twist_transform(
    v0: torch.Tensor, w0: torch.Tensor, t01: torch.Tensor, q01: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a body's linear and angular velocity at another frame of it, in that frame's axes."""
    return quat_apply_inverse(q01, v0 + cross(w0, t01)), quat_apply_inverse(q01, w0)


def compute_pose_error(
    t01: torch.Tensor,
    q01: torch.Tensor,
    t02: torch.Tensor,
    q02: torch.Tensor,
    rot_error_type: Literal["quat", "axis_angle"] = "axis_angle",
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return position and rotation from frame 1 to frame 2, the rotation as a quaternion or a rotation vector.

    Raises:
        ValueError: another type.
    """
    if rot_error_type not in ("quat", "axis_angle"):
        raise ValueError(f"rot_error_type is {rot_error_type!r}, expected 'quat' or 'axis_angle'")
    turn = quat_mul(q02, quat_inv(q01))
    return t02 - t01, turn if rot_error_type == "quat" else axis_angle_from_quat(turn)


def apply_delta_pose(
    source_pos: torch.Tensor, source_rot: torch.Tensor, delta_pose: torch.Tensor, eps: float = SMALL
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move poses by (..., 6): a position and a rotation vector; one shorter than ``eps`` turns nothing."""
    delta = delta_pose[..., 3:6]
    angle = torch.linalg.vector_norm(delta, dim=-1)
    turned = quat_mul(quat_from_angle_axis(angle, delta), source_rot)
    return source_pos + delta_pose[..., :3], torch.where(angle.unsqueeze(-1) > eps, turned, source_rot)


def is_identity_pose(pos: torch.Tensor, rot: torch.Tensor) -> bool:
    """Return whether poses are all zero and unturned."""
    none = rot.new_tensor([1.0, 0.0, 0.0, 0.0]).expand_as(rot)
    return torch.allclose(pos, torch.zeros_like(pos)) and torch.allclose(rot, none)


def transform_points(
    points: torch.Tensor, pos: torch.Tensor | None = None, quat: torch.Tensor | None = None
) -> torch.Tensor:
    """Turn, then move points (P, 3) or (N, P, 3) by poses (3,), (4,) or (N, 3), (N, 4)."""
    batch = points.unsqueeze(0) if points.dim() == 2 else points
    if quat is not None:
        batch = quat_apply(quat.reshape(-1, 1, 4), batch)
    if pos is not None:
        batch = batch + pos.reshape(-1, 1, 3)
    return batch.squeeze(0) if points.dim() == 2 else batch


def make_pose(pos: torch.Tensor, rot: torch.Tensor) -> torch.Tensor:
    """Return the matrices (..., 4, 4) of positions and rotation matrices."""
    pose = torch.zeros(*pos.shape[:-1], 4, 4, dtype=pos.dtype, device=pos.device)
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rot, pos, 1.0
    return pose


def unmake_pose(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return positions and rotation matrices of matrices (..., 4, 4)."""
    return pose[..., :3, 3], pose[..., :3, :3]


def pose_inv(pose: torch.Tensor) -> torch.Tensor:
    """Return the inverse matrices (..., 4, 4)."""
    position, turn = unmake_pose(pose)
    return make_pose(-(turn.mT @ position.unsqueeze(-1)).squeeze(-1), turn.mT)
