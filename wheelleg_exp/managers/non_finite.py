"""Detect NaN and inf, name the manager term that produced NaN or inf, and save the state that led to it."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable
from typing import Any

import torch

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.managers.async_queries import finite_watch, is_finite
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import ids_where

MOST_SAVED = 16  # The state of at most 16 environments is saved for one failure.
PHYSICS = "env.sim"
ACTIONS = "env.actions"
POLICY = "agent.actor"
LARGEST_ACTION = 1e6  # Raw actions are about 1; squares of larger ones can overflow in a reward.


def may_fail(sums: Iterable[torch.Tensor]) -> bool:
    """Return whether the given numbers contain NaN or inf, or whether their sum overflows to inf."""
    return not is_finite(functools.reduce(torch.add, sums))


def failed_rows(values: torch.Tensor) -> torch.Tensor:
    """Return the indices of the rows of a tensor that contain NaN or inf."""
    return ids_where(~values.reshape(len(values), -1).isfinite().all(dim=1))


def failures(env: Env, env_ids: torch.Tensor) -> dict[str, Any]:
    """Return a dictionary with the entries ``keys`` and ``evidence`` about NaN or inf in the environments ``env_ids``.

    ``keys`` maps the index of each failed environment to the config keys of the terms with NaN or inf, and ``evidence``
    contains the states. Reward terms are not listed if the physics failed, or if an action was not finite or larger
    than ``LARGEST_ACTION``, because rewards can then become NaN, too.
    """
    bad_actions = set(ids_where(~(env.action_manager.action.abs() <= LARGEST_ACTION).all(dim=1)).tolist())
    chosen = set(env_ids.tolist())
    rewards = {i: names for i, names in env.reward_manager.non_finite.items() if i in chosen}
    keys = {i: [f"env.rewards.{name}" for name in names] or ["env.rewards"] for i, names in rewards.items()}
    keys |= {i: [ACTIONS] for i in bad_actions & keys.keys()}
    unstable = env_ids[env.scene.unstable()[env_ids]]
    keys |= {i: [ACTIONS if i in bad_actions else PHYSICS] for i in unstable.tolist()}
    keys = dict(sorted(keys.items()))
    return {"keys": keys, "evidence": evidence(env, torch.tensor(list(keys), device=env.device))}


def evidence(env: Env, ids: torch.Tensor, **more: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the state of the first ``MOST_SAVED`` of the environments ``ids``: arrays by name, one row for each.

    The array ``state`` is the present state of the physics engine. Because the engine resets a failed simulation,
    ``motion_at_start`` has the positions and velocities from the start of the control step. Arrays such as
    ``model.body_mass`` are fields of the MuJoCo model that events changed. The result also contains the rows ``ids`` of
    the tensors (N, ...) in ``more``.
    """
    ids = ids[:MOST_SAVED].to(env.device)
    scene, actions, observed = env.scene, env.action_manager, env.observation_manager.obs_buf
    rows = {
        "episode_length": env.episode_length_buf,
        "state": scene.sim.state,
        **{name: scene.sim.view(name) for name in ("qpos", "qvel", "ctrl")},
        "motion_at_start": scene.robot.data.motion_at_start,
        "action": actions.action,
        "previous_action": actions.prev_action,
        "rewards": env.reward_manager.raw_values.T,
        **{f"observation.{name}": value for name, value in observed.items() if isinstance(value, torch.Tensor)},
        **{f"model.{name}": values for name, values in sorted(scene.sim.expanded.items())},
        **more,
    }
    return {"env_ids": ids.clone(), **{name: values[ids].detach().clone() for name, values in rows.items()}}


def require_finite_writes(env: Env, path: str, asked: Collection[str], ids: torch.Tensor | None) -> None:
    """Raise SimulationFailure if the event at the key ``path`` wrote NaN or inf to model fields or wrenches."""
    rows = slice(None) if ids is None else ids
    written = env.scene.written(asked) if asked else {}
    if may_fail([env.scene.sim.total(rows), *(values[rows].sum() for values in written.values())]):
        written = {**env.scene.motion(), **written}
        before = set(ids_where(env.scene.unstable()).tolist())  # Do not blame the event for earlier failures.
        for name, values in written.items():
            bad = set(failed_rows(values).tolist()) - before
            bad &= bad if ids is None else set(ids.tolist())
            if bad:
                found = torch.tensor(sorted(bad), device=env.device)
                raise failure(env, path, f"the event wrote numbers that are not finite into {name}", found)


def note_observations(env: Env) -> None:
    """Start to check on a GPU whether the current observations are finite, without waiting for the result."""
    if env.device.type == "cuda" and (parts := _parts(env)):
        finite_watch(env.device).note(functools.reduce(torch.add, [part.sum() for part in parts]))


def require_finite_observations(env: Env, only: torch.Tensor | None = None, is_noted: bool = False) -> None:
    """Raise SimulationFailure if observations contain NaN or inf.

    It names the first such term. ``only`` (N,) bool selects environments. Set ``is_noted`` after ``note_observations``.
    """
    if is_noted and env.device.type == "cuda" and finite_watch(env.device).is_calm():
        return
    parts = _parts(env)
    if parts and may_fail(part.sum() for part in parts):
        for group, value in env.observation_manager.obs_buf.items():
            for term, part in env.observation_manager.split(group, value).items():
                chosen = part if only is None else part.masked_fill(~only.view(-1, *[1] * (part.ndim - 1)), 0.0)
                if len(bad := failed_rows(chosen)):
                    path = f"env.observations.{group}.terms.{term}"
                    raise failure(env, path, "the term gave observations that are not finite", bad)


def _parts(env: Env) -> list[torch.Tensor]:
    groups = env.observation_manager.obs_buf.values()
    return [part for value in groups for part in ([value] if isinstance(value, torch.Tensor) else value.values())]


def require_finite_actions(env: Env, actions: torch.Tensor) -> None:
    """Raise SimulationFailure if the actions (N, A) of a policy are NaN or inf: its networks failed."""
    if may_fail([actions.sum()]) and len(bad := failed_rows(actions)):
        raise failure(env, POLICY, "the policy's actions are not finite", bad, actions=actions)


def failure(env: Env, key: str, what: str, ids: torch.Tensor, **more: torch.Tensor) -> SimulationFailure:
    """Return the error for NaN or inf, with the state of the environments in which NaN or inf occurred."""
    first = ", ".join(str(i) for i in ids[:3].tolist()) + (", …" if len(ids) > 3 else "")
    message = f"{what} in {len(ids)} of {env.num_envs} environments ({first}), control step {env.common_step_counter}"
    found = evidence(env, ids, **more) if hasattr(env, "reward_manager") else {}
    return SimulationFailure(message, key=key, expected="finite numbers", evidence=found)
