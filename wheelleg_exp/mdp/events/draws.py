"""What event terms draw with: distributions, operations, and which environments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import torch

from wheelleg_exp.constraints import Interval
from wheelleg_exp.managers import Env

Operation = Literal["add", "scale", "abs"]
Distribution = Literal["uniform", "log_uniform", "gaussian"]
Pose = Literal["x", "y", "z", "roll", "pitch", "yaw"]
PoseRange = Mapping[Pose, Interval]
POSE = get_args(Pose)


def draw(
    low: float, high: float, shape: tuple[int, ...], distribution: Distribution, generator: torch.Generator
) -> torch.Tensor:
    """Return draws of ``shape``: uniform or log-uniform on [low, high], or Gaussian with mean low and std high."""
    if distribution == "gaussian":
        return low + high * torch.randn(shape, generator=generator, device=generator.device)
    u = torch.rand(shape, generator=generator, device=generator.device)
    if distribution == "log_uniform":
        return low * (high / low) ** u
    return low + (high - low) * u


def operate(default: torch.Tensor, drawn: torch.Tensor, operation: Operation) -> torch.Tensor:
    """Return default + drawn (add), default * drawn (scale) or drawn (abs)."""
    if operation == "add":
        return default + drawn
    return default * drawn if operation == "scale" else drawn


def all_ids(env: Env, env_ids: torch.Tensor | None) -> torch.Tensor:
    """Return ``env_ids``, or all environments for None."""
    return torch.arange(env.num_envs, device=env.device) if env_ids is None else env_ids
