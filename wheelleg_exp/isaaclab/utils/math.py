"""Functions for rotations, frames, cameras, and random numbers, with the names of ``isaaclab.utils.math``.

Quaternions are (w, x, y, z), angles are radians, and leading dimensions are broadcast. Random functions use torch's
global generator, a user-defined term's random stream while it runs. TorchScript can compile what Isaac Lab compiles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.sensors.cameras import Convention, convert_convention

wrap_to_pi = rotation.wrap_to_pi
Quaternions = TypeVar("Quaternions", torch.Tensor, NDArray[np.float64])
_broadcast: Callable[..., tuple[torch.Tensor, ...]] = torch.broadcast_tensors  # without annotations in torch
SMALL = 1e-6  # Below ``SMALL`` (rad), formulas do not divide by the angle, but use an approximation.


def cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return cross products of vectors, whose leading dimensions are broadcast."""
    first, second = _broadcast(a, b)
    product: torch.Tensor = torch.linalg.cross(first, second)
    return product


def normalize(x: torch.Tensor, eps: float = 1e-9) -> torch.Tensor:
    """Divide vectors by their length, or by ``eps`` if they are shorter than ``eps``."""
    return torch.nn.functional.normalize(x, dim=-1, eps=eps)


def quat_conjugate(q: torch.Tensor) -> torch.Tensor:
    """Return (w, -x, -y, -z)."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def quat_inv(q: torch.Tensor, eps: float = 1e-9) -> torch.Tensor:
    """Return the inverse: the conjugate divided by the squared norm, or by ``eps`` if the squared norm is smaller."""
    return quat_conjugate(q) / q.square().sum(dim=-1, keepdim=True).clamp(min=eps)


def quat_mul(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the Hamilton product: the rotation ``q2`` followed by ``q1``."""
    if q1.shape != q2.shape:
        raise ValueError(f"quaternions of shapes {list(q1.shape)} and {list(q2.shape)} cannot be multiplied")
    w1, x1, y1, z1 = q1.unbind(dim=-1)
    w2, x2, y2, z2 = q2.unbind(dim=-1)
    w, x = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2, w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
    y, z = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2, w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2
    return torch.stack((w, x, y, z), dim=-1)


def quat_unique(q: torch.Tensor) -> torch.Tensor:
    """Return the quaternions with w >= 0 that describe the same rotations as the given quaternions."""
    return torch.where(q[..., :1] < 0.0, -q, q)


def quat_apply(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors; as in Isaac Lab, as many rotations as vectors may have another leading shape."""
    if quat.shape[:-1] != vec.shape[:-1] and 3 * quat.numel() == 4 * vec.numel():
        quat = quat.reshape(vec.shape[:-1] + quat.shape[-1:])
    w, axis = quat[..., :1], quat[..., 1:]
    turn = 2.0 * cross(axis, vec)
    return vec + w * turn + cross(axis, turn)


def quat_apply_inverse(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors by the inverse rotations of quaternions."""
    return quat_apply(quat_conjugate(quat), vec)


quat_rotate = quat_apply
quat_rotate_inverse = quat_apply_inverse


def yaw_quat(quat: torch.Tensor) -> torch.Tensor:
    """Return only the yaw rotation (about z) of each rotation, as quaternions."""
    w, x, y, z = quat.unbind(dim=-1)
    half = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) / 2.0
    zero = torch.zeros_like(half)
    return normalize(torch.stack((half.cos(), zero, zero, half.sin()), dim=-1))


def quat_apply_yaw(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors only by the yaw angles of rotations."""
    return quat_apply(yaw_quat(quat), vec)


def quat_from_angle_axis(angle: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return the quaternions of rotations by angles (...) about axes (..., 3) of any length."""
    half = angle.unsqueeze(-1) / 2.0
    return normalize(torch.cat((half.cos(), normalize(axis) * half.sin()), dim=-1))


def axis_angle_from_quat(quat: torch.Tensor, eps: float = SMALL) -> torch.Tensor:
    """Return the rotation vectors (..., 3), with lengths of at most pi, of quaternions."""
    quat = quat_unique(quat)
    sine = torch.linalg.vector_norm(quat[..., 1:], dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, quat[..., :1])
    # For small angles a, sin(a / 2) / a is approximately 1/2 - a^2 / 48.
    per_angle = torch.where(angle > eps, sine / angle.clamp(min=eps), 0.5 - angle.square() / 48.0)
    return quat[..., 1:] / per_angle


def quat_box_minus(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the rotation vector (..., 3), world axes, that rotates ``q2`` to ``q1``."""
    return axis_angle_from_quat(quat_mul(q1, quat_conjugate(q2)))


def quat_box_plus(q: torch.Tensor, delta: torch.Tensor, eps: float = SMALL) -> torch.Tensor:
    """Apply rotation vectors (..., 3), world axes, to quaternions; the resulting quaternions have w >= 0."""
    angle = torch.linalg.vector_norm(delta, dim=-1, keepdim=True).clamp(min=eps)
    half = angle / 2.0
    turn = torch.cat((half.cos(), delta / angle * half.sin()), dim=-1)
    return quat_unique(quat_mul(turn, q))


def quat_error_magnitude(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the angles (...) between pairs of rotations."""
    angles: torch.Tensor = torch.linalg.vector_norm(quat_box_minus(q1, q2), dim=-1)
    return angles


def quat_slerp(q1: torch.Tensor, q2: torch.Tensor, tau: float) -> torch.Tensor:
    """Interpolate between the quaternions ``q1`` (tau 0) and ``q2`` (tau 1) along the shorter arc (Shoemake 1985)."""
    cosine = (q1 * q2).sum()
    q2, cosine = torch.where(cosine < 0.0, -q2, q2), cosine.abs().clamp(max=1.0)
    angle = torch.acos(cosine)
    line = normalize(torch.lerp(q1, q2, tau))  # Linear interpolation of quaternions is accurate for small angles.
    arc = (torch.sin((1.0 - tau) * angle) * q1 + torch.sin(tau * angle) * q2) / torch.sin(angle).clamp(min=1e-12)
    return torch.where(angle < 1e-4, line, arc)


def convert_quat(quat: Quaternions, to: Literal["xyzw", "wxyz"] = "xyzw") -> Quaternions:
    """Convert quaternions (tensor or array) between the orders xyzw and wxyz."""
    if quat.shape[-1] != 4 or to not in ("xyzw", "wxyz"):
        raise ValueError(f"expected quaternions (..., 4) and to='xyzw' or 'wxyz', not {tuple(quat.shape)} and {to!r}")
    shift = -1 if to == "xyzw" else 1
    return np.roll(quat, shift, axis=-1) if isinstance(quat, np.ndarray) else quat.roll(shift, dims=-1)


def quat_from_euler_xyz(roll: torch.Tensor, pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternions (..., 4) of Rz(yaw) Ry(pitch) Rx(roll) for angles (...)."""
    roll, pitch, yaw = _broadcast(roll, pitch, yaw)
    zero = torch.zeros_like(roll)
    about_x = torch.stack(((roll / 2.0).cos(), (roll / 2.0).sin(), zero, zero), dim=-1)
    about_y = torch.stack(((pitch / 2.0).cos(), zero, (pitch / 2.0).sin(), zero), dim=-1)
    about_z = torch.stack(((yaw / 2.0).cos(), zero, zero, (yaw / 2.0).sin()), dim=-1)
    return quat_mul(about_z, quat_mul(about_y, about_x))


def euler_xyz_from_quat(
    quat: torch.Tensor, wrap_to_2pi: bool = False
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return roll, pitch and yaw (...); roll and yaw are in [-pi, pi], or all three are in [0, 2 pi)."""
    w, x, y, z = quat.unbind(dim=-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if wrap_to_2pi:
        return roll % (2.0 * torch.pi), pitch % (2.0 * torch.pi), yaw % (2.0 * torch.pi)
    return roll, pitch, yaw


def matrix_from_quat(quaternions: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrices (..., 3, 3) of quaternions, which can have any length except 0."""
    axes = torch.eye(3, dtype=quaternions.dtype, device=quaternions.device)
    return quat_apply(normalize(quaternions).unsqueeze(-2), axes).transpose(-1, -2).contiguous()


def quat_from_matrix(matrix: torch.Tensor) -> torch.Tensor:
    """Return the quaternions (..., 4) of rotation matrices, computed by Shepperd's method (1978)."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x, y, z = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    # Each row of the matrix 4 q q^T is a multiple of the quaternion q.
    # Normalise the longest row of 4 q q^T, because normalising a short row is inaccurate.
    w_row, x_row = (1.0 + xx + yy + zz, x, y, z), (x, 1.0 + xx - yy - zz, xy, xz)
    y_row, z_row = (y, xy, 1.0 - xx + yy - zz, yz), (z, xz, yz, 1.0 - xx - yy + zz)
    rows = torch.stack([torch.stack(row, dim=-1) for row in (w_row, x_row, y_row, z_row)], dim=-2)
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = torch.take_along_dim(rows, largest[..., None, None], dim=-2).squeeze(-2)
    return normalize(row)


def matrix_from_euler(euler_angles: torch.Tensor, convention: str) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) from three Euler angles (..., 3) about axes such as ``"XYZ"``."""
    turns = []
    for angle, axis in zip(euler_angles.unbind(dim=-1), convention, strict=True):
        unit = torch.zeros(3, dtype=angle.dtype, device=angle.device)
        unit["XYZ".index(axis)] = 1.0
        turns.append(matrix_from_quat(quat_from_angle_axis(angle, unit.expand(*angle.shape, 3))))
    return turns[0] @ turns[1] @ turns[2]


def skew_symmetric_matrix(vec: torch.Tensor) -> torch.Tensor:
    """Return the skew-symmetric matrices (n, 3, 3) of vectors (n, 3) or (3,)."""
    vec = vec.reshape(-1, 3)
    return cross(vec.unsqueeze(-2), torch.eye(3, dtype=vec.dtype, device=vec.device)).mT.contiguous()


def combine_frame_transforms(
    t01: torch.Tensor, q01: torch.Tensor, t12: torch.Tensor | None = None, q12: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose of frame 2 in frame 0 from the poses of frame 1 in frame 0 and of frame 2 in frame 1."""
    return t01 if t12 is None else t01 + quat_apply(q01, t12), q01 if q12 is None else quat_mul(q01, q12)


def subtract_frame_transforms(
    t01: torch.Tensor, q01: torch.Tensor, t02: torch.Tensor | None = None, q02: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose of frame 2 in frame 1, given the poses of frame 1 and of frame 2 in frame 0."""
    back = quat_inv(q01)
    return quat_apply(back, -t01 if t02 is None else t02 - t01), back if q02 is None else quat_mul(back, q02)


def rigid_body_twist_transform(
    v0: torch.Tensor, w0: torch.Tensor, t01: torch.Tensor, q01: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Convert linear and angular velocity from frame 0 to frame 1, which are both fixed to one rigid body."""
    return quat_apply_inverse(q01, v0 + cross(w0, t01)), quat_apply_inverse(q01, w0)


def compute_pose_error(
    t01: torch.Tensor,
    q01: torch.Tensor,
    t02: torch.Tensor,
    q02: torch.Tensor,
    rot_error_type: str = "axis_angle",
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the position and the rotation from frame 1 to frame 2, as a quaternion or a rotation vector."""
    if rot_error_type not in ("quat", "axis_angle"):
        raise ValueError(f"rot_error_type is '{rot_error_type}', expected 'quat' or 'axis_angle'")
    turn = quat_mul(q02, quat_inv(q01))
    return t02 - t01, turn if rot_error_type == "quat" else axis_angle_from_quat(turn)


def apply_delta_pose(
    source_pos: torch.Tensor, source_rot: torch.Tensor, delta_pose: torch.Tensor, eps: float = SMALL
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move poses by (..., 6): a position and a rotation vector, which is ignored if it is shorter than ``eps``."""
    delta = delta_pose[..., 3:6]
    angle = torch.linalg.vector_norm(delta, dim=-1)
    turned = quat_mul(quat_from_angle_axis(angle, delta), source_rot)
    return source_pos + delta_pose[..., :3], torch.where(angle.unsqueeze(-1) > eps, turned, source_rot)


def is_identity_pose(pos: torch.Tensor, rot: torch.Tensor) -> bool:
    """Return whether all given poses are the identity pose."""
    identity = rot.new_tensor([1.0, 0.0, 0.0, 0.0]).expand_as(rot)
    return torch.allclose(pos, torch.zeros_like(pos)) and torch.allclose(rot, identity)


def transform_points(
    points: torch.Tensor, pos: torch.Tensor | None = None, quat: torch.Tensor | None = None
) -> torch.Tensor:
    """Rotate, then translate points (P, 3) or (N, P, 3) by the quaternions and positions of poses."""
    batch = points.unsqueeze(0) if points.dim() == 2 else points
    if quat is not None:
        batch = quat_apply(quat.reshape(-1, 1, 4), batch)
    if pos is not None:
        batch = batch + pos.reshape(-1, 1, 3)
    return batch.squeeze(0) if points.dim() == 2 else batch


def make_pose(pos: torch.Tensor, rot: torch.Tensor) -> torch.Tensor:
    """Return the homogeneous matrices (..., 4, 4) of positions and rotation matrices."""
    pose = torch.zeros(*pos.shape[:-1], 4, 4, dtype=pos.dtype, device=pos.device)
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rot, pos, 1.0
    return pose


def unmake_pose(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the positions and rotation matrices of homogeneous matrices (..., 4, 4)."""
    return pose[..., :3, 3], pose[..., :3, :3]


def pose_inv(pose: torch.Tensor) -> torch.Tensor:
    """Return the inverses of homogeneous matrices (..., 4, 4)."""
    position, turn = unmake_pose(pose)
    return make_pose(-(turn.mT @ position.unsqueeze(-1)).squeeze(-1), turn.mT)


def convert_camera_frame_orientation_convention(
    orientation: torch.Tensor, origin: Convention = "opengl", target: Convention = "ros"
) -> torch.Tensor:
    """Convert camera orientations (..., 4) between the conventions ``opengl``, ``ros`` and ``world``."""
    return convert_convention(orientation.reshape(-1, 4), origin, target).reshape(orientation.shape)


def create_rotation_matrix_from_view(
    eyes: torch.Tensor, targets: torch.Tensor, up_axis: Literal["Y", "Z"] = "Z", device: str = "cpu"
) -> torch.Tensor:
    """Return the rotations (N, 3, 3) of cameras at (N, 3) that look at targets (N, 3), in the convention ``opengl``.

    For a camera that looks straight up or down, the right side of the image points along the world's x axis.
    """
    up = torch.tensor([0.0, 1.0, 0.0] if up_axis == "Y" else [0.0, 0.0, 1.0], device=device).expand_as(eyes)
    back = torch.nn.functional.normalize(eyes - targets, dim=1)
    right = torch.linalg.cross(up, back, dim=1)
    along = torch.tensor([1.0, 0.0, 0.0], device=device).expand_as(eyes)
    right = torch.where(torch.linalg.vector_norm(right, dim=1, keepdim=True) < 1e-5, along, right)
    right = torch.nn.functional.normalize(right, dim=1)
    return torch.stack((right, torch.linalg.cross(back, right, dim=1), back), dim=2)


def orthogonalize_perspective_depth(depth: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Convert distances along pixels' rays to distances along the camera's axis, m.

    ``depth`` is (H, W), (H, W, 1), (N, H, W), or (N, H, W, 1); ``intrinsics``, px, is (3, 3) or (N, 3, 3).
    """
    pictures = _pictures(depth)
    matrices = intrinsics.reshape(-1, 3, 3)
    v, u = _pixels(pictures)
    x, y = matrices[:, 0, :, None, None], matrices[:, 1, :, None, None]
    cosine = torch.rsqrt(1.0 + ((u - x[:, 2]) / x[:, 0]).square() + ((v - y[:, 2]) / y[:, 1]).square())
    return (pictures * cosine).reshape(depth.shape)


def unproject_depth(depth: torch.Tensor, intrinsics: torch.Tensor, is_ortho: bool = True) -> torch.Tensor:
    """Return the points (P, 3) or (N, P, 3) of pixels, m, column by column, in axes x right, y down, z forward.

    Shapes as in ``orthogonalize_perspective_depth``. ``is_ortho`` means distances along the axis, not along the rays.
    """
    pictures = _pictures(depth if is_ortho else orthogonalize_perspective_depth(depth, intrinsics))
    v, u = _pixels(pictures)
    pixels = torch.stack((u, v, torch.ones_like(u)), dim=-1)
    rays = torch.einsum("nij,hwj->nhwi", torch.linalg.inv(intrinsics.reshape(-1, 3, 3)), pixels)
    points = (rays * pictures.unsqueeze(-1)).transpose(1, 2).flatten(1, 2)
    is_one = depth.dim() == 2 or (depth.dim() == 3 and depth.shape[-1] == 1)
    return points.squeeze(0) if is_one and intrinsics.dim() == 2 else points


def project_points(points: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return the pixel column, pixel row, and distance along the camera's axis, m, of points (P, 3) or (N, P, 3), m."""
    batch = points.unsqueeze(0) if points.dim() == 2 else points
    seen = torch.einsum("nij,npj->npi", intrinsics.reshape(-1, 3, 3), batch)
    found = torch.cat((seen[..., :2] / seen[..., 2:], batch[..., 2:]), dim=-1)
    return found.squeeze(0) if points.dim() == 2 and intrinsics.dim() == 2 else found


def _pictures(depth: torch.Tensor) -> torch.Tensor:
    flat = depth.squeeze(-1) if depth.dim() > 2 and depth.shape[-1] == 1 else depth
    return flat.unsqueeze(0) if flat.dim() == 2 else flat


def _pixels(pictures: torch.Tensor) -> list[torch.Tensor]:
    rows = torch.arange(pictures.shape[1], device=pictures.device, dtype=pictures.dtype)
    columns = torch.arange(pictures.shape[2], device=pictures.device, dtype=pictures.dtype)
    return list(torch.meshgrid(rows, columns, indexing="ij"))


Size = int | tuple[int, ...]
Device = torch.device | str | None
Bound = torch.Tensor | float


def _shape(size: Size) -> tuple[int, ...]:
    return (size,) if isinstance(size, int) else tuple(size)


def sample_uniform(lower: Bound, upper: Bound, size: Size, device: Device) -> torch.Tensor:
    """Return random numbers that are uniform on [lower, upper)."""
    return torch.rand(_shape(size), device=device) * (upper - lower) + lower


def sample_log_uniform(lower: Bound, upper: Bound, size: Size, device: Device) -> torch.Tensor:
    """Return random numbers on [lower, upper) whose logarithm is uniform."""
    low, high = (torch.as_tensor(bound, dtype=torch.float32, device=device).log() for bound in (lower, upper))
    return sample_uniform(low, high, size, device).exp()


def sample_gaussian(mean: Bound, std: Bound, size: Size, device: Device) -> torch.Tensor:
    """Return Gaussian random numbers; if the mean is a tensor, the numbers have the shape of the mean."""
    shape = tuple(mean.shape) if isinstance(mean, torch.Tensor) else _shape(size)
    return torch.randn(shape, device=device) * std + mean


def sample_triangle(lower: float, upper: float, size: Size, device: Device) -> torch.Tensor:
    """Return random numbers on [lower, upper] whose density is highest at the bounds, as in Isaac Lab."""
    u = 2.0 * torch.rand(_shape(size), device=device) - 1.0
    return lower + (upper - lower) * (1.0 + u.sign() * u.abs().sqrt()) / 2.0


def sample_cylinder(radius: float, h_range: tuple[float, float], size: Size, device: Device) -> torch.Tensor:
    """Return random points (..., 3), uniform on the lateral surface of a cylinder about z."""
    angle = (2.0 * torch.rand(_shape(size), device=device) - 1.0) * torch.pi
    height = sample_uniform(h_range[0], h_range[1], size, device)
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height), dim=-1)


def default_orientation(num: int, device: str) -> torch.Tensor:
    """Return a tensor (num, 4) of identity quaternions (1, 0, 0, 0)."""
    return torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(num, 1)


def random_orientation(num: int, device: str) -> torch.Tensor:
    """Return rotations uniform on SO(3), (num, 4): normalised 4-d Gaussians (Marsaglia 1972)."""
    return torch.nn.functional.normalize(torch.randn(num, 4, device=device), dim=-1)


def random_yaw_orientation(num: int, device: str) -> torch.Tensor:
    """Return quaternions (num, 4) of rotations about z by uniform random angles."""
    yaw = 2.0 * torch.pi * torch.rand(num, device=device)
    return quat_from_euler_xyz(torch.zeros_like(yaw), torch.zeros_like(yaw), yaw)


def scale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map values linearly from [lower, upper] to [-1, 1]."""
    return (2.0 * x - lower - upper) / (upper - lower)


def unscale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map values linearly from [-1, 1] to [lower, upper]."""
    return ((upper - lower) * x + lower + upper) / 2.0


def saturate(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Clamp between bounds."""
    return torch.maximum(torch.minimum(x, upper), lower)


def copysign(mag: float, other: torch.Tensor) -> torch.Tensor:
    """Return the magnitude ``|mag|`` with the signs of the elements of a tensor."""
    return torch.copysign(torch.full_like(other, abs(mag)), other)
