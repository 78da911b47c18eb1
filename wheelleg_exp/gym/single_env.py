"""One environment behind ``gymnasium.Env``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from wheelleg_exp.gym.task import Arrays, action_space, as_arrays, observation_space, task_env


class WheellegEnv(gymnasium.Env[Arrays, np.ndarray]):
    """A task as a single environment; it never resets by itself.

    Args:
        task: a task's name.
        overrides: Hydra overrides.
        config_dirs: folders of the user's own configs.

    Raises:
        WheellegError: the task, an override or the robot is wrong.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, task: str = "stand", overrides: Sequence[str] = (), config_dirs: Sequence[str | Path] = ()
    ) -> None:
        self.env = task_env(task, 1, overrides, config_dirs)
        self.env.auto_reset = False
        self.observation_space: gymnasium.Space[Arrays] = observation_space(self.env)  # type: ignore[assignment]
        self.action_space = action_space(self.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Arrays, dict[str, Any]]:
        """Begin an episode; a seed starts all random streams anew."""
        super().reset(seed=seed, options=options)
        observations, _ = self.env.reset(seed=seed)
        return _first(as_arrays(observations)), {}

    def step(self, action: np.ndarray) -> tuple[Arrays, float, bool, bool, dict[str, Any]]:
        """Advance by one control step, for a raw action (A,).

        Where a reward or the physics was not finite, the episode has failed with a reward of 0, and ``non_finite`` in
        the info says whose numbers these were.
        """
        raw = torch.as_tensor(np.asarray(action, dtype=np.float32)).unsqueeze(0)
        observations, reward, terminated, truncated, extras = self.env.step(raw)
        info = {"non_finite": extras["non_finite"]["keys"][0]} if "non_finite" in extras else {}
        return _first(as_arrays(observations)), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


def _first(arrays: Arrays) -> Arrays:
    return {group: value[0] for group, value in arrays.items()}
