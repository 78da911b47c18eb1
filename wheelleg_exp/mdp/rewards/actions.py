"""Rewards on raw actions."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env, TermBase
from wheelleg_exp.sim.ids import fill_rows


def action_rate_l2(env: Env) -> torch.Tensor:
    """Sum of squared changes of the raw action."""
    return (env.action_manager.action - env.action_manager.prev_action).square().sum(dim=1)


def action_l2(env: Env) -> torch.Tensor:
    """Sum of squared raw actions."""
    return env.action_manager.action.square().sum(dim=1)


class action_acceleration_l2(TermBase):
    """Sum of squared second differences of the raw action, (a - 2 a_1 + a_2)^2. Not in Isaac Lab.

    Before an episode's first action all are 0, as in ``action_rate_l2``.

    Args:
        env: the environment.
    """

    def __init__(self, env: Env) -> None:
        self._before_last = torch.zeros_like(env.action_manager.action)

    def __call__(self, env: Env) -> torch.Tensor:
        """Compare with the last two actions."""
        action, last = env.action_manager.action, env.action_manager.prev_action
        second_difference = action - 2.0 * last + self._before_last
        self._before_last.copy_(last)
        return second_difference.square().sum(dim=1)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the actions of ``env_ids``."""
        fill_rows(self._before_last, env_ids, 0.0)
