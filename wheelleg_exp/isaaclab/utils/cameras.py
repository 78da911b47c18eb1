"""Cameras' frames, pixels and distances; pixel (0, 0) is the upper left one, at its number, as in Isaac Lab."""

from __future__ import annotations

from typing import Literal

import torch

from wheelleg_exp.sim.sensors.camera_data import Convention, convert_convention


def convert_camera_frame_orientation_convention(
    orientation: torch.Tensor, origin: Convention = "opengl", target: Convention = "ros"
) -> torch.Tensor:
    """Return the same orientations (..., 4) by the axes of another convention: ``opengl``, ``ros`` or ``world``."""
    flat = orientation.reshape(-1, 4)
    return convert_convention(flat, origin, target).reshape(orientation.shape)


def create_rotation_matrix_from_view(
    eyes: torch.Tensor, targets: torch.Tensor, up_axis: Literal["Y", "Z"] = "Z", device: str = "cpu"
) -> torch.Tensor:
    """Return the rotations (N, 3, 3) of cameras at (N, 3) that look at targets (N, 3), axes of ``opengl``.

    Straight up or down the picture's right is the world's x.
    """
    up = torch.tensor([0.0, 1.0, 0.0] if up_axis == "Y" else [0.0, 0.0, 1.0], device=device).expand_as(eyes)
    back = torch.nn.functional.normalize(eyes - targets, dim=1)
    right = torch.linalg.cross(up, back, dim=1)
    along = torch.tensor([1.0, 0.0, 0.0], device=device).expand_as(eyes)
    right = torch.where(torch.linalg.vector_norm(right, dim=1, keepdim=True) < 1e-5, along, right)
    right = torch.nn.functional.normalize(right, dim=1)
    return torch.stack((right, torch.linalg.cross(back, right, dim=1), back), dim=2)


def orthogonalize_perspective_depth(depth: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return distances along the axis, m, for those along pixels' rays: (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1).

    ``intrinsics``, px, is (3, 3) or (N, 3, 3).
    """
    pictures = _pictures(depth)
    matrices = intrinsics.reshape(-1, 3, 3)
    v, u = (part.unsqueeze(0) for part in _pixels(pictures))
    f_x, f_y, c_x, c_y = (matrices[:, i, j].view(-1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    cosine = torch.rsqrt(1.0 + ((u - c_x) / f_x).square() + ((v - c_y) / f_y).square())
    return (pictures * cosine).reshape(depth.shape)


def unproject_depth(depth: torch.Tensor, intrinsics: torch.Tensor, is_ortho: bool = True) -> torch.Tensor:
    """Return the points (P, 3) or (N, P, 3), m, that pixels show, axes x right, y down, z forward; column by column.

    Args:
        depth: distances, m: (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1).
        intrinsics: px, (3, 3) or (N, 3, 3).
        is_ortho: whether distances are along the axis; else along the pixels' rays.
    """
    along = depth if is_ortho else orthogonalize_perspective_depth(depth, intrinsics)
    pictures = _pictures(along)
    v, u = _pixels(pictures)
    pixels = torch.stack((u, v, torch.ones_like(u)), dim=-1)
    rays = torch.einsum("nij,hwj->nhwi", torch.linalg.inv(intrinsics.reshape(-1, 3, 3)), pixels)
    points = (rays * pictures.unsqueeze(-1)).transpose(1, 2).flatten(1, 2)
    is_one = depth.dim() == 2 or (depth.dim() == 3 and depth.shape[-1] == 1)
    return points.squeeze(0) if is_one and intrinsics.dim() == 2 else points


def project_points(points: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return where points (P, 3) or (N, P, 3), m, are seen: column and row, px, and distance along the axis, m."""
    batch = points.unsqueeze(0) if points.dim() == 2 else points
    seen = torch.einsum("nij,npj->npi", intrinsics.reshape(-1, 3, 3), batch)
    found = torch.cat((seen[..., :2] / seen[..., 2:], batch[..., 2:]), dim=-1)
    return found.squeeze(0) if points.dim() == 2 and intrinsics.dim() == 2 else found


def _pictures(depth: torch.Tensor) -> torch.Tensor:
    """Return distances as (N, H, W)."""
    flat = depth.squeeze(-1) if depth.dim() > 2 and depth.shape[-1] == 1 else depth
    return flat.unsqueeze(0) if flat.dim() == 2 else flat


def _pixels(pictures: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return the rows' and the columns' numbers, (H, W) each."""
    counts = (torch.arange(count, device=pictures.device, dtype=pictures.dtype) for count in pictures.shape[1:])
    return torch.meshgrid(*counts, indexing="ij")
