"""The vector environment: a task with N environments as a ``gymnasium.vector.VectorEnv``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.gym import task_env
from wheelleg_exp.gym.task_env import RENDER_MODES, Arrays, action_space, as_arrays, observation_space
from wheelleg_exp.state import host_copy

_NAMES: dict[AutoresetMode, Literal["same_step", "next_step", "disabled"]] = {
    AutoresetMode.SAME_STEP: "same_step",
    AutoresetMode.NEXT_STEP: "next_step",
    AutoresetMode.DISABLED: "disabled",
}
_MODES: dict[str, AutoresetMode] = {name: mode for mode, name in _NAMES.items()}


class WheellegVectorEnv(VectorEnv[Arrays, np.ndarray, np.ndarray]):
    """A task as a Gymnasium vector environment; infos have the layout of ``SyncVectorEnv``.

    ``same_step``: a done environment is reset within the step; ``final_obs`` and ``final_info`` contain its last
    observation and info, and the returned observation is the first of the next episode. ``next_step``: a done
    environment is reset in the next step, whose action is ignored and whose reward is 0. ``disabled``: the caller
    resets done environments with ``reset(options={"reset_mask": ...})``. In the infos, ``log`` is the managers' log,
    averaged over the episodes that ended in the step. If a reward or the physics becomes NaN or inf, the episode fails
    with a reward of 0, and ``non_finite`` in the infos lists the config keys of the failed terms.

    Args:
        num_envs: number of environments, N.
        autoreset_mode: ``same_step``, ``next_step``, ``disabled``, or a value of Gymnasium's ``AutoresetMode``.

    The arguments from ``task`` to ``height`` have the same meaning as in ``WheellegEnv``.
    """

    metadata: dict[str, object] = {  # noqa: RUF012
        "render_modes": RENDER_MODES,
        "render_fps": 60,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "stand",
        overrides: Sequence[str] = (),
        config_dirs: str | Path | Sequence[str | Path] = (),
        action_bound: float | Sequence[float] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        self.autoreset_mode = _autoreset(autoreset_mode)  # TorchRL reads this attribute
        self.env = task_env.task_env(task, num_envs, overrides, config_dirs)
        self.env.autoreset = _NAMES[self.autoreset_mode]
        self.env.keep_final_obs = self.autoreset_mode is AutoresetMode.SAME_STEP
        self.num_envs = num_envs
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = action_space(self.env, action_bound)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = render_mode
        self.metadata = {"render_modes": list(RENDER_MODES), "autoreset_mode": self.autoreset_mode}
        self.metadata["render_fps"] = round(1 / self.env.step_dt)
        self._pictures = task_env.Pictures(self.env, render_mode, width, height)
        self._done = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, object] | None = None
    ) -> tuple[Arrays, dict[str, object]]:
        """Reset all environments, or only the environments in the mask ``options["reset_mask"]`` (N,).

        The argument ``seed`` restarts the random streams of all environments.
        """
        if isinstance(seed, list):
            raise ValueError("the environments share their random streams: give one seed, not a list")
        mask = _reset_mask(options, self.num_envs)
        if mask is not None and seed is not None:
            raise ValueError(
                "the environments share their random streams: give a seed only if all environments are reset"
            )
        super().reset(seed=seed, options=options)
        left = host_copy(self.env.episode_length_buf > 0)
        if mask is None:
            observations, _ = self.env.reset(seed=seed)
            self._done[:] = False
        else:
            observations, _ = self.env.reset(env_ids=torch.from_numpy(mask).nonzero().squeeze(1))
            self._done[mask] = False
            left &= mask
        return as_arrays(observations), self._log(left) if left.any() else {}

    def step(self, actions: np.ndarray) -> tuple[Arrays, np.ndarray, np.ndarray, np.ndarray, dict[str, object]]:
        """Advance every environment by one control step with raw actions (N, A)."""
        if self.autoreset_mode is AutoresetMode.DISABLED and self._done.any():
            done = np.flatnonzero(self._done).tolist()
            raise ResetNeeded(
                f"the episodes of the environments {done} have ended; reset them with options['reset_mask']"
            )
        started = self._done
        action = torch.as_tensor(np.asarray(actions, dtype=np.float32))
        observations, reward, terminated, truncated, extras = self.env.step(action)
        self._done = host_copy(terminated | truncated)
        infos: dict[str, object] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            started = self._done
            final_obs = as_arrays(extras["final_obs"])
            non_finite = extras["non_finite"]["keys"] if "non_finite" in extras else {}
            for env_id in np.flatnonzero(self._done).tolist():
                info = {"non_finite": non_finite[env_id]} if env_id in non_finite else {}
                last = {group: value[env_id] for group, value in final_obs.items()}
                self._add_info(infos, {"final_obs": last, "final_info": info}, env_id)
        elif "non_finite" in extras:
            for env_id, keys in extras["non_finite"]["keys"].items():
                self._add_info(infos, {"non_finite": keys}, env_id)
        if extras["log_is_fresh"]:
            infos |= self._log(started)
        rewards = host_copy(reward.double())
        return as_arrays(observations), rewards, host_copy(terminated), host_copy(truncated), infos

    def _log(self, which: NDArray[np.bool_]) -> dict[str, object]:
        log: dict[str, object] = {}
        for key, value in task_env.log_of(self.env).items():
            log |= {key: np.where(which, value, 0.0), f"_{key}": which.copy()}
        return {"log": log, "_log": which.copy()}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return an image (height, width, 3) of every environment, or None without a ``render_mode``."""
        return self._pictures.draw()

    def call(self, name: str, *args: object, **kwargs: object) -> tuple[Any, ...]:
        """Return the attribute ``name``, or the result of the method ``name``, once for each environment."""
        found = getattr(self, name)
        answer = found(*args, **kwargs) if callable(found) else found
        return answer if name == "render" and answer is not None else (answer,) * self.num_envs

    def close_extras(self, **kwargs: object) -> None:
        """Stop the rendering process."""
        del kwargs
        self._pictures.close()


def _autoreset(mode: str | AutoresetMode) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    found = _MODES.get(str(mode)) or next((known for known in AutoresetMode if known.value == mode), None)
    if found is None:
        expected = "one of " + ", ".join(_MODES)
        nearest = nearest_name(str(mode), _MODES)
        raise ConfigError(f"unknown mode '{mode}'", key="autoreset_mode", expected=expected, nearest=nearest)
    return found


def _reset_mask(options: dict[str, object] | None, num_envs: int) -> NDArray[np.bool_] | None:
    if not options or "reset_mask" not in options:
        return None
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"options['reset_mask'] is a {type(mask).__name__}; expected an array of bool")
    if mask.shape != (num_envs,) or not mask.any():
        raise ValueError(f"options['reset_mask'] is {mask}; expected ({num_envs},) with at least one True")
    return mask
