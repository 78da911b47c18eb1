"""Rewards on raw actions."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env


def action_rate_l2(env: Env) -> torch.Tensor:
    """Sum of squared changes of the raw action."""
    return (env.action_manager.action - env.action_manager.prev_action).square().sum(dim=1)


def action_l2(env: Env) -> torch.Tensor:
    """Sum of squared raw actions."""
    return env.action_manager.action.square().sum(dim=1)
