"""What one frame holds of the learning problem: actions, observations, rewards, terminations, the episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.host import host_copy
from wheelleg_exp.recording.layout import EnvPaths
from wheelleg_exp.recording.writing.channels import Channel, one, row
from wheelleg_exp.recording.writing.frames import Episodes


def learning_channels(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths, episodes: Episodes) -> list[Channel]:
    """Return what is recorded of one environment's managers at every control step."""
    return [
        *_actions(env, env_id, paths),
        *_observations(env, env_id, paths),
        *_rewards(env, env_id, paths),
        *_terminations(env, env_id, paths),
        *_episode(env, env_id, paths, episodes),
    ]


def _actions(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    """The policy's output, and what the terms made of it."""
    manager = env.action_manager
    terms = {name: manager.get_term(name) for name in manager.active_terms}
    raw = {name: term.action_dim for name, term in terms.items()}
    processed = {name: int(term.processed_actions.shape[1]) for name, term in terms.items()}

    def made() -> Any:
        parts = [host_copy(term.processed_actions[env_id]) for term in terms.values()]
        return np.concatenate(parts) if parts else []

    return [
        one("actions/raw", paths.data("actions", "raw"), _names(env, raw), row(lambda: manager.action, env_id)),
        one("actions/processed", paths.data("actions", "processed"), _names(env, processed), made),
    ]


def _names(env: ManagerBasedRLEnv, widths: dict[str, int]) -> list[str]:
    names: list[str] = []
    for name, width in widths.items():
        joints = getattr(env.action_manager.get_term(name), "joint_names", None)
        if joints is None or len(joints) != width:
            joints = [str(i) for i in range(width)]
        names += [f"{name}[{joint}]" for joint in joints]
    return names


def _observations(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    """The observation that led to the recorded action, term by term; NaN before the first one is computed."""
    manager, found = env.observation_manager, []
    for group, terms in manager.active_terms.items():
        for term, shape in zip(terms, manager.group_obs_term_dim[group], strict=True):
            if len(shape) > 2:  # pictures are not recorded number by number
                continue
            names = _labels(term, shape)
            read = _observation(env, env_id, group, term, len(names))
            key = ("observations", group, term)
            found.append(one("/".join(key), paths.data(*key), names, read))
    return found


def _labels(term: str, shape: tuple[int, ...]) -> list[str]:
    """Return a name for each number of a term; a history that is not flattened is its leading axis."""
    if len(shape) == 1:
        return [f"{term}[{i}]" for i in range(shape[0])]
    return [f"{term}[{i}]@{h}" for h in range(shape[0]) for i in range(shape[1])]


def _observation(env: ManagerBasedRLEnv, env_id: int, group: str, term: str, width: int) -> Callable[[], Any]:
    manager, nothing = env.observation_manager, np.full(width, np.nan)

    def read() -> Any:
        value = manager.obs_buf.get(group)
        if value is None:
            return nothing
        mine = value[env_id : env_id + 1] if isinstance(value, torch.Tensor) else value
        part = manager.part(group, term, mine)
        return host_copy(part[0 if mine is not value else env_id]).ravel()

    return read


def _rewards(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    """Each term's weighted value per second, and their sum per second as the learner got it."""
    manager, names = env.reward_manager, env.reward_manager.active_terms
    places = tuple(paths.data("rewards", name) for name in names)
    terms = Channel("rewards", tuple(names), lambda: host_copy(manager.step_reward[:, env_id]), places)
    total = paths.data("rewards", "total")
    return [terms, one("total", total, ["total"], lambda: host_copy(env.reward_buf[env_id]) / env.step_dt)]


def _terminations(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    manager, names = env.termination_manager, env.termination_manager.active_terms
    fired = [manager.get_term(name) for name in names]
    places = tuple(paths.data("terminations", name) for name in names)
    read = (lambda: host_copy(torch.stack(fired)[:, env_id])) if fired else list
    return [Channel("terminations", tuple(names), read, places)]


def _episode(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths, episodes: Episodes) -> list[Channel]:
    """Which episode a row belongs to, how far it is, and whether it ends with this row."""
    manager = env.termination_manager

    def read() -> Sequence[float]:
        failed, over = bool(manager.terminated[env_id]), bool(manager.time_outs[env_id])
        return (episodes.number, int(host_copy(env.episode_length_buf[env_id])), failed, over)

    names = ("number", "step", "terminated", "truncated")
    return [Channel("episode", names, read, tuple(paths.data("episode", name) for name in names))]
