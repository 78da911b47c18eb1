"""Build a task's environment, define the environment's Gymnasium spaces, and render images of the environment."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from wheelleg_exp.build import build_env
from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.composing.compose import override_texts
from wheelleg_exp.env import ManagerBasedRLEnv, Observations
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.packages import with_current
from wheelleg_exp.rendering.live_pictures import LivePictures
from wheelleg_exp.state import host_copy

Arrays = dict[str, np.ndarray]


def task_env(
    task: str, num_envs: int, overrides: Sequence[str], config_dirs: str | Path | Sequence[str | Path]
) -> ManagerBasedRLEnv:
    """Compose and check a task's config, and build the environment."""
    given = override_texts(overrides)
    if any(word.lstrip("+").startswith("env.num_envs=") for word in given):
        message = "Gymnasium sets the number of environments"
        raise ConfigError(message, key="env.num_envs", expected="make_vec(..., num_envs=N)")
    words = [f"task={task}", *given, f"env.num_envs={num_envs}"]
    folders = [config_dirs] if isinstance(config_dirs, (str, Path)) else config_dirs
    composed = compose_valid(words, config_dirs=with_current([Path(folder) for folder in folders]))
    with composed.placing():
        env = build_env(composed.config, composed.asset_roots)
        for group, concatenated in env.observation_manager.group_obs_concatenate.items():
            if not concatenated:
                key = f"env.observations.{group}.concatenate_terms"
                raise ConfigError(
                    "Gymnasium needs one array per observation group, so the group's terms must be concatenated",
                    key=key,
                    expected="true",
                )
    return env


def observation_space(env: ManagerBasedRLEnv) -> gymnasium.spaces.Dict:
    """Return the space of one environment's observations: unbounded float32 vectors by group."""
    boxes: dict[str, gymnasium.Space[Any]] = {}
    for group, shape in env.observation_manager.group_obs_dim.items():
        boxes[group] = gymnasium.spaces.Box(-np.inf, np.inf, cast(tuple[int, ...], shape), np.float32)
    return gymnasium.spaces.Dict(boxes)


def action_space(env: ManagerBasedRLEnv, bound: float | Sequence[float] | None) -> gymnasium.spaces.Box:
    """Return the Gymnasium space of one environment's raw actions, with one bound or one bound per action."""
    width = env.action_manager.total_action_dim
    if bound is None:
        return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)
    try:
        given = np.asarray(bound)
        high = np.broadcast_to(given.astype(np.float32), (width,)).copy() if given.dtype.kind in "iuf" else None
    except (ValueError, TypeError):
        high = None
    if high is None or not (np.isfinite(high).all() and (high > 0).all()):
        expected = f"a number above 0, {width} such numbers, or None"
        raise ConfigError(f"{bound!r} is not a valid bound of actions", key="action_bound", expected=expected)
    return gymnasium.spaces.Box(-high, high, dtype=np.float32)


def as_arrays(observations: Observations) -> Arrays:
    """Return copies of the observations as NumPy arrays."""
    return {group: host_copy(value) for group, value in observations.items() if isinstance(value, torch.Tensor)}


def log_of(env: ManagerBasedRLEnv) -> dict[str, float]:
    """Return the managers' log of the episodes that ended at the last reset, by name."""
    return {key: float(value) for key, value in env.extras["log"].items()}


RENDER_MODES = ["rgb_array"]
_SIZE_PX = (16, 4096)


class Pictures:
    """Renders images of environments one by one, without a change to the states of the environments."""

    def __init__(self, env: ManagerBasedRLEnv, mode: str | None, width: int, height: int) -> None:
        if mode is not None and mode not in RENDER_MODES:
            expected, nearest = " or ".join([*RENDER_MODES, "None"]), nearest_name(str(mode), RENDER_MODES)
            raise ConfigError(f"unknown mode '{mode}'", key="render_mode", expected=expected, nearest=nearest)
        for key, size in (("width", width), ("height", height)):
            whole = isinstance(size, Integral) and not isinstance(size, bool)
            if not (whole and _SIZE_PX[0] <= size <= _SIZE_PX[1]):
                expected = "a whole number of px, {} to {}".format(*_SIZE_PX)
                raise ConfigError(f"{size!r} is not a valid image size in pixels", key=key, expected=expected)
        self._env, self._mode = env, mode
        self._pictures = LivePictures(env.scene.model, env.scene.robot.body_names[0], width, height)

    def draw(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return an image (height, width, 3) of every environment, or None if the render mode is None."""
        if self._mode is None:
            return None
        return tuple(self._pictures.draw(row) for row in host_copy(self._env.scene.sim.view("qpos")).astype(float))

    def close(self) -> None:
        """Stop the rendering process."""
        self._pictures.close()
