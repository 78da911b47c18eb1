"""Weights of rewards that change."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Natural
from wheelleg_exp.managers import Env


def modify_reward_weight(env: Env, env_ids: torch.Tensor, term_name: str, weight: float, num_steps: Natural) -> float:
    """Set a reward's weight once ``common_step_counter > num_steps`` (control steps); returns the present weight."""
    del env_ids  # the step counter is everybody's
    term = env.reward_manager.get_term_cfg(term_name)
    if env.common_step_counter > num_steps:
        term.fields["weight"] = weight
    return float(term.fields["weight"])
