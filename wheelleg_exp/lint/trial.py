"""A short trial under random actions: what each reward is worth before anything has been learned."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import Composed

_ENVS, _SECONDS = 32, 2.0


def random_rewards(composed: Composed) -> Mapping[str, float]:
    """Return the mean of each reward term while the actions are standard normal, by name, per second.

    Args:
        composed: a config without mistakes. It is run with 32 environments for two seconds.

    Raises:
        WheellegError: the environment cannot be built.
    """
    config = copy.deepcopy(composed.config)
    config["env"]["num_envs"] = _ENVS
    env = build_env(config, composed.asset_roots)
    stream = torch.Generator(device=env.device).manual_seed(int(config["seed"]))
    env.reset()
    steps = max(1, round(_SECONDS / env.step_dt))
    total = torch.zeros(len(env.reward_manager.active_terms), device=env.device)
    for _ in range(steps):
        shape = (_ENVS, env.action_manager.total_action_dim)
        env.step(torch.randn(shape, generator=stream, device=env.device))
        total += env.reward_manager.step_reward.mean(dim=1)
    return dict(zip(env.reward_manager.active_terms, (total / steps).tolist(), strict=True))
