"""Holds bodies of a sensor against bodies or joints of the robot."""

from __future__ import annotations

import torch

from wheelleg_exp.errors import ConfigError


def require_pairs(first: torch.Tensor, second: torch.Tensor, key: str) -> None:
    """Raise ConfigError unless two tensors (N, k, ...) speak of as many things.

    Args:
        first: of the bodies of ``sensor_cfg``.
        second: of what ``key`` names.
        key: the key below the term's.
    """
    if first.shape[1] != second.shape[1]:
        raise ConfigError(
            f"{first.shape[1]} bodies of the sensor, and {second.shape[1]} of the robot",
            key=key,
            expected="as many, in the same order as in sensor_cfg.body_names",
        )
