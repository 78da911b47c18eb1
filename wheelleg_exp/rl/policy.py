"""A trained policy on its own: from a checkpoint, without the algorithm that trained it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rsl_rl.models import MLPModel

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.algorithm import build_algorithm
from wheelleg_exp.rl.vec_env import RslRlVecEnv


def load_policy(path: Path, env: RslRlVecEnv, agent: Mapping[str, Any]) -> MLPModel:
    """Return the policy of a checkpoint, in evaluation mode: its mean action, without exploration noise.

    Args:
        path: the checkpoint.
        env: an environment with the same observations and actions.
        agent: the run's ``agent`` section.

    Raises:
        RunDirectoryError: the checkpoint is damaged or does not fit the environment.
    """
    state = checkpoint.load(path)
    policy = build_algorithm(env, {**agent, "device": str(env.env.device)}).get_policy()
    try:
        policy.load_state_dict(checkpoint.policy_state(state))
    except (RuntimeError, TypeError, AttributeError) as error:
        raise RunDirectoryError(
            "does not fit this environment's observations and actions",
            key=str(path),
            expected="the observations, actions and networks that it was trained with",
        ) from error
    policy.eval()
    return policy
