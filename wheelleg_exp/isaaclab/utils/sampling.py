"""Draws from torch's global generator, which is a term's own stream while the term runs."""

from __future__ import annotations

from typing import Any

import torch

from wheelleg_exp.sim import rotation

Size = int | tuple[int, ...]
Bound = torch.Tensor | float


def _shape(size: Size) -> tuple[int, ...]:
    return (size,) if isinstance(size, int) else tuple(size)


def sample_uniform(lower: Bound, upper: Bound, size: Size, device: Any) -> torch.Tensor:
    """Return uniform draws on [lower, upper)."""
    return torch.rand(_shape(size), device=device) * (upper - lower) + lower


def sample_log_uniform(lower: Bound, upper: Bound, size: Size, device: Any) -> torch.Tensor:
    """Return draws on [lower, upper) whose logarithm is uniform."""
    low, high = (torch.as_tensor(bound, dtype=torch.float32, device=device).log() for bound in (lower, upper))
    return sample_uniform(low, high, size, device).exp()


def sample_gaussian(mean: Bound, std: Bound, size: Size, device: Any) -> torch.Tensor:
    """Return Gaussian draws; with a tensor as mean, of its shape."""
    shape = tuple(mean.shape) if isinstance(mean, torch.Tensor) else _shape(size)
    return torch.randn(shape, device=device) * std + mean


def sample_triangle(lower: float, upper: float, size: Size, device: Any) -> torch.Tensor:
    """Return draws on [lower, upper] that are likeliest at the ends, as Isaac Lab's of that name."""
    u = 2.0 * torch.rand(_shape(size), device=device) - 1.0
    return lower + (upper - lower) * (1.0 + u.sign() * u.abs().sqrt()) / 2.0


def sample_cylinder(radius: float, h_range: tuple[float, float], size: Size, device: Any) -> torch.Tensor:
    """Return points (..., 3) uniform on the side of a cylinder about z."""
    angle = (2.0 * torch.rand(_shape(size), device=device) - 1.0) * torch.pi
    height = sample_uniform(h_range[0], h_range[1], size, device)
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height), dim=-1)


def default_orientation(num: int, device: Any) -> torch.Tensor:
    """Return (1, 0, 0, 0), (num, 4)."""
    return torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(num, 1)


def random_orientation(num: int, device: Any) -> torch.Tensor:
    """Return rotations uniform on SO(3), (num, 4): normalised 4-d Gaussians (Marsaglia 1972)."""
    return torch.nn.functional.normalize(torch.randn(num, 4, device=device), dim=-1)


def random_yaw_orientation(num: int, device: Any) -> torch.Tensor:
    """Return rotations about z by uniform angles, (num, 4)."""
    yaw = 2.0 * torch.pi * torch.rand(num, device=device)
    return rotation.quat_from_euler_xyz(torch.zeros_like(yaw), torch.zeros_like(yaw), yaw)
