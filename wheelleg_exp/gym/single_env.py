"""The single environment: a task as a ``gymnasium.Env``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from wheelleg_exp.gym import task_env
from wheelleg_exp.gym.task_env import RENDER_MODES, Arrays, action_space, as_arrays, observation_space


class WheellegEnv(gymnasium.Env[Arrays, np.ndarray]):
    """A task as a Gymnasium environment with one robot. The environment never resets automatically.

    Args:
        task: a task's name.
        overrides: Hydra overrides of the task's config, as a list, or one override as a string.
        config_dirs: folders of the user's own configs, or one folder.
        action_bound: largest size of an action in ``action_space``, one number for all or (A,); None means unbounded.
            Larger actions are not clipped.
        render_mode: ``rgb_array``, or None.
        width: width of images, px.
        height: height of images, px.
    """

    metadata: dict[str, object] = {"render_modes": RENDER_MODES, "render_fps": 60}  # noqa: RUF012

    def __init__(
        self,
        task: str = "stand",
        overrides: Sequence[str] = (),
        config_dirs: str | Path | Sequence[str | Path] = (),
        action_bound: float | Sequence[float] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
    ) -> None:
        self.env = task_env.task_env(task, 1, overrides, config_dirs)
        self.env.autoreset = "disabled"
        self.observation_space: gymnasium.Space[Arrays] = observation_space(self.env)  # type: ignore[assignment]
        self.action_space = action_space(self.env, action_bound)
        self.render_mode = render_mode
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / self.env.step_dt)}
        self._pictures = task_env.Pictures(self.env, render_mode, width, height)

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Arrays, dict[str, object]]:
        """Start an episode; the argument ``seed`` restarts all random streams.

        If an episode was played before, the returned info contains its logged values as ``log``.
        """
        super().reset(seed=seed, options=options)
        has_run = bool(self.env.episode_length_buf[0])
        observations, _ = self.env.reset(seed=seed)
        return _first(as_arrays(observations)), {"log": task_env.log_of(self.env)} if has_run else {}

    def step(self, action: np.ndarray) -> tuple[Arrays, float, bool, bool, dict[str, object]]:
        """Advance the environment by one control step with a raw action (A,).

        If a reward or the physics becomes NaN or inf, the episode fails with a reward of 0, and ``non_finite`` in the
        returned info lists the config keys of the failed terms.
        """
        raw = torch.as_tensor(np.asarray(action, dtype=np.float32)).unsqueeze(0)
        observations, reward, terminated, truncated, extras = self.env.step(raw)
        info = {"non_finite": extras["non_finite"]["keys"][0]} if "non_finite" in extras else {}
        return _first(as_arrays(observations)), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """Return an image (height, width, 3), or None without a ``render_mode``."""
        drawn = self._pictures.draw()
        return None if drawn is None else drawn[0]

    def close(self) -> None:
        """Stop the rendering process."""
        self._pictures.close()


def _first(arrays: Arrays) -> Arrays:
    return {group: value[0] for group, value in arrays.items()}
