"""Rotations, frames and draws under the names of ``isaaclab.utils.math``; quaternions are (w, x, y, z), angles radians.

Tensors may have any leading dimensions, which broadcast. What draws takes torch's global generator, which is the
term's own stream while one of a user's terms runs.
"""

from __future__ import annotations

import torch

from wheelleg_exp.isaaclab.utils.cameras import (
    convert_camera_frame_orientation_convention,
    create_rotation_matrix_from_view,
    orthogonalize_perspective_depth,
    project_points,
    unproject_depth,
)
from wheelleg_exp.isaaclab.utils.frames import (
    apply_delta_pose,
    combine_frame_transforms,
    compute_pose_error,
    is_identity_pose,
    make_pose,
    pose_inv,
    rigid_body_twist_transform,
    subtract_frame_transforms,
    transform_points,
    unmake_pose,
)
from wheelleg_exp.isaaclab.utils.rotations import (
    axis_angle_from_quat,
    convert_quat,
    euler_xyz_from_quat,
    matrix_from_euler,
    matrix_from_quat,
    normalize,
    quat_apply,
    quat_apply_inverse,
    quat_apply_yaw,
    quat_box_minus,
    quat_box_plus,
    quat_conjugate,
    quat_error_magnitude,
    quat_from_angle_axis,
    quat_from_euler_xyz,
    quat_from_matrix,
    quat_inv,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
    quat_slerp,
    quat_unique,
    skew_symmetric_matrix,
    yaw_quat,
)
from wheelleg_exp.isaaclab.utils.sampling import (
    default_orientation,
    random_orientation,
    random_yaw_orientation,
    sample_cylinder,
    sample_gaussian,
    sample_log_uniform,
    sample_triangle,
    sample_uniform,
)
from wheelleg_exp.sim.rotation import wrap_to_pi

__all__ = [
    "apply_delta_pose",
    "axis_angle_from_quat",
    "combine_frame_transforms",
    "compute_pose_error",
    "convert_camera_frame_orientation_convention",
    "convert_quat",
    "copysign",
    "create_rotation_matrix_from_view",
    "default_orientation",
    "euler_xyz_from_quat",
    "is_identity_pose",
    "make_pose",
    "matrix_from_euler",
    "matrix_from_quat",
    "normalize",
    "orthogonalize_perspective_depth",
    "pose_inv",
    "project_points",
    "quat_apply",
    "quat_apply_inverse",
    "quat_apply_yaw",
    "quat_box_minus",
    "quat_box_plus",
    "quat_conjugate",
    "quat_error_magnitude",
    "quat_from_angle_axis",
    "quat_from_euler_xyz",
    "quat_from_matrix",
    "quat_inv",
    "quat_mul",
    "quat_rotate",
    "quat_rotate_inverse",
    "quat_slerp",
    "quat_unique",
    "random_orientation",
    "random_yaw_orientation",
    "rigid_body_twist_transform",
    "sample_cylinder",
    "sample_gaussian",
    "sample_log_uniform",
    "sample_triangle",
    "sample_uniform",
    "saturate",
    "scale_transform",
    "skew_symmetric_matrix",
    "subtract_frame_transforms",
    "transform_points",
    "unmake_pose",
    "unproject_depth",
    "unscale_transform",
    "wrap_to_pi",
    "yaw_quat",
]


def scale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map [lower, upper] to [-1, 1]."""
    return (2.0 * x - lower - upper) / (upper - lower)


def unscale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map [-1, 1] to [lower, upper]."""
    return ((upper - lower) * x + lower + upper) / 2.0


def saturate(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Clamp between bounds."""
    return torch.maximum(torch.minimum(x, upper), lower)


def copysign(mag: float, other: torch.Tensor) -> torch.Tensor:
    """Return ``|mag|`` with the signs of a tensor."""
    return torch.copysign(torch.full_like(other, abs(mag)), other)
