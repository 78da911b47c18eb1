"""N environments behind ``gymnasium.vector.VectorEnv``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from wheelleg_exp.env.host import host_copy
from wheelleg_exp.gym.task import Arrays, action_space, as_arrays, observation_space, task_env


class WheellegVectorEnv(VectorEnv[Arrays, np.ndarray, np.ndarray]):
    """A task as a vector environment with same-step autoreset.

    An environment that is done is reset within the step: its last observation stands in ``infos["final_obs"]``
    (rows where ``infos["_final_obs"]`` is true), the returned one begins the next episode. Where a reward or the
    physics was not finite, the environment has failed with a reward of 0: ``infos["non_finite"]`` says whose numbers
    these were.

    Args:
        num_envs: number of environments, N.
        task: a task's name.
        overrides: Hydra overrides.
        config_dirs: folders of the user's own configs.

    Raises:
        WheellegError: the task, an override or the robot is wrong.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "stand",
        overrides: Sequence[str] = (),
        config_dirs: Sequence[str | Path] = (),
    ) -> None:
        self.env = task_env(task, num_envs, overrides, config_dirs)
        self.env.keep_final_obs = True
        self.num_envs = num_envs
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = action_space(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Arrays, dict[str, Any]]:
        """Reset every environment; one seed starts all random streams anew."""
        if isinstance(seed, list):
            raise ValueError("the environments share their random streams: give one seed, not a list")
        super().reset(seed=seed, options=options)
        observations, _ = self.env.reset(seed=seed)
        return as_arrays(observations), {}

    def step(self, actions: np.ndarray) -> tuple[Arrays, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance every environment by one control step, for raw actions (N, A)."""
        action = torch.as_tensor(np.asarray(actions, dtype=np.float32))
        observations, reward, terminated, truncated, extras = self.env.step(action)
        infos: dict[str, Any] = {}
        if "final_obs" in extras:
            infos["final_obs"] = as_arrays(extras["final_obs"])
            infos["_final_obs"] = host_copy(terminated | truncated)
        if extras["log_is_fresh"]:
            infos["log"] = {key: float(value) for key, value in extras["log"].items()}
        if "non_finite" in extras:
            infos["non_finite"] = np.full(self.num_envs, None, dtype=object)
            for env_id, keys in extras["non_finite"]["keys"].items():
                infos["non_finite"][env_id] = keys
            infos["_non_finite"] = np.array([keys is not None for keys in infos["non_finite"]])
        rewards = host_copy(reward.double())
        return as_arrays(observations), rewards, host_copy(terminated), host_copy(truncated), infos
