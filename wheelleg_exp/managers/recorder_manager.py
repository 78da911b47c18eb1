"""Recorders: what each episode was, kept as a dataset. They look, and change nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.machine import require_memory
from wheelleg_exp.managers.manager_base import ManagerBase, Term, TermBase, table
from wheelleg_exp.managers.recorded_rows import Rows, noted
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.terms.config_sections import Dataset

Noted = tuple[str | None, torch.Tensor | Mapping[str, Any] | None]
Arrays = dict[str, np.ndarray]
_SUCCESS = "success"  # the termination whose firing makes an episode a success
_OWN = ("episode", "rows")  # heads of the keys that tell of the episodes themselves


class RecorderTerm(TermBase):
    """Notes quantities under keys; subclasses override the hooks that they need.

    A hook returns a key and a tensor with a row for each environment, or a mapping of such tensors, whose keys are
    joined by ``/``; or None and None.

    Attributes:
        reads_observations: whether ``record_post_step`` reads ``obs_buf``, which then holds the observations of the
            state before resets, without noise. They are computed anew for it, and no state or stream moves.

    Args:
        env: the environment; action and later managers are not there yet.
    """

    reads_observations: ClassVar[bool] = True

    def __init__(self, env: Env) -> None:
        self._env = env

    def record_pre_step(self) -> Noted:
        """Return what holds as an action begins to act; ``obs_buf`` is what led to it."""
        return None, None

    def record_post_physics_decimation_step(self) -> Noted:
        """Return what holds after a physics step, before sensors are read."""
        return None, None

    def record_post_step(self) -> Noted:
        """Return what holds at the end of a control step, before anything is reset."""
        return None, None

    def record_pre_reset(self, env_ids: torch.Tensor) -> Noted:  # noqa: ARG002
        """Return what holds at the end of the episodes of ``env_ids``, a row for each of these."""
        return None, None

    def record_post_reset(self, env_ids: torch.Tensor) -> Noted:  # noqa: ARG002
        """Return what the new episodes of ``env_ids`` begin with, a row for each of these."""
        return None, None


class RecorderManager(ManagerBase):
    """Cuts what recorders note into episodes, and hands those that have ended to whoever writes them.

    A dataset holds whole episodes: one that was under way when a state was loaded has lost its beginning and is left
    out. What is noted is no state of the environment: with and without recorders a checkpoint is the same. With
    Gymnasium's ``next_step`` the step that only resets is an episode's last.

    Args:
        nodes: the terms by name.
        options: the ``env.dataset`` section.
        env: the environment under construction.
    """

    kind = "recorders"

    def __init__(self, nodes: Mapping[str, Any] | None, options: Dataset, env: Env) -> None:
        super().__init__(nodes, env)
        self._options = options
        for term in self._terms.values():
            if not isinstance(term.func, RecorderTerm):
                raise ConfigError(
                    f"'{term.target}' is no recorder", key=term.path, expected="a subclass of RecorderTerm"
                )
        self._hooks = {name: self._having(name) for name in vars(RecorderTerm) if name.startswith("record_")}
        self._reads = any(t.reads_observations for _, t in self._hooks["record_post_step"])
        self._rows: dict[str, Rows] = {}
        self._initial: dict[str, Rows] = {}
        self._owners: dict[str, str] = {}
        self._is_whole = np.zeros(self._num_envs, dtype=bool)
        self._finished: dict[str, list[tuple[dict[str, Any], Arrays]]] = {}

    def record_pre_step(self) -> None:
        """Let recorders look before the action acts."""
        self._append("record_pre_step")

    def record_post_physics_decimation_step(self) -> None:
        """Let recorders look after a physics step."""
        self._append("record_post_physics_decimation_step")

    def record_post_step(self) -> None:
        """Let recorders look after rewards and terminations, before resets; see ``reads_observations``."""
        manager = self._env.observation_manager
        kept = manager.obs_buf
        if self._reads:
            manager.obs_buf = manager.peek()
        try:
            self._append("record_post_step")
        finally:
            manager.obs_buf = kept

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        """End the episodes of ``env_ids``: those that had a step, and whose beginning is known, are finished."""
        if not self._terms or self._options.export_mode == "none":
            return
        last = self._only("record_pre_reset", env_ids)
        self._finish_episodes(env_ids, last)

    def record_post_reset(self, env_ids: torch.Tensor) -> None:
        """Begin the episodes of ``env_ids``."""
        if not self._terms:
            return
        ids = env_ids.cpu().numpy()
        for key, value in self._only("record_post_reset", env_ids).items():
            self._initial.setdefault(key, Rows(self._num_envs)).set(ids, value)

    def reset(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Begin new episodes of ``env_ids``; recorders log nothing."""
        if self._terms:
            ids = env_ids.cpu().numpy()
            for rows in self._rows.values():
                rows.begin(ids)
            self._is_whole[ids] = True
            self._reset_terms(env_ids)
        return {}

    def close(self) -> None:
        """End the episodes under way too, where ``env.dataset.export_in_close`` asks for it."""
        if self._options.export_in_close:
            self.record_pre_reset(torch.arange(self._num_envs, device=self._env.device))
            self._is_whole[:] = False

    def take(self) -> dict[str, Arrays]:
        """Return the episodes that have ended since the last call, by group, as arrays by name.

        Groups are ``episodes``, or ``succeeded`` and ``failed``. ``episode/env``, ``episode/length`` (control steps),
        ``episode/last_step`` (control steps since the environment was made) and ``episode/success`` have a number for
        each episode. Under its own key each quantity has the rows of all episodes one after another, and
        ``rows/<key>`` says how many are each one's.
        """
        found = {group: _joined(episodes) for group, episodes in self._finished.items()}
        self._finished = {}
        return found

    def forget(self) -> None:
        """Leave the episodes under way out: the environment has become another."""
        self._is_whole[:] = False

    def state_dict(self) -> dict[str, Any]:
        """Return the states of recorders of a user's own that have one; the stock ones have none."""
        states = {name: term.state_dict() for name, term in self._terms.items()}
        kept = {name: state for name, state in states.items() if state["settings"] or state["object"]}
        return {"terms": kept} if kept else {}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for name, state in saved.get("terms", {}).items():
            self._terms[name].load_state_dict(state)

    def _having(self, hook: str) -> list[tuple[Term, RecorderTerm]]:
        """Return the terms that override a hook."""
        pairs = [(term, term.func) for term in self._terms.values()]
        return [(t, f) for t, f in pairs if getattr(type(f), hook) is not getattr(RecorderTerm, hook)]  # type: ignore[misc]

    def _noted(self, hook: str, rows: int, *args: torch.Tensor) -> Iterator[tuple[str, np.ndarray]]:
        for term, recorder in self._hooks[hook]:
            with term.blamed():
                found = list(noted(getattr(recorder, hook)(*args), rows, f"'{term.target}.{hook}'", recorder))
                for name, _ in found:
                    self._require_own(name, term.path)
            yield from found

    def _require_own(self, key: str, owner: str) -> None:
        """Raise ConfigError where two hooks note under one key, or under a key of the episodes' own."""
        first = self._owners.setdefault(key, owner)
        if first != owner:
            raise ConfigError(f"'{key}' is noted by {first} as well", expected="a key for each quantity")
        if key.split("/")[0] in _OWN:
            raise ConfigError(f"'{key}' tells of the episodes themselves", expected="another key")

    def _append(self, hook: str) -> None:
        if not self._hooks[hook]:
            return
        for name, array in self._noted(hook, self._num_envs):
            if name not in self._rows:
                what = f"{self._env.max_episode_length} steps of '{name}' of {self._num_envs} environments"
                require_memory(array.nbytes * self._env.max_episode_length, self._owners[name], what)
                self._rows[name] = Rows(self._num_envs)
            self._rows[name].append(array, self._owners[name])

    def _only(self, hook: str, env_ids: torch.Tensor) -> Arrays:
        return {name: array.copy() for name, array in self._noted(hook, len(env_ids), env_ids)}

    def _finish_episodes(self, env_ids: torch.Tensor, last: Arrays) -> None:
        ends = self._env.termination_manager
        success = [False] * len(env_ids)
        if _SUCCESS in ends.active_terms:
            success = ends.get_term(_SUCCESS)[env_ids].tolist()
        lengths = self._env.episode_length_buf[env_ids].tolist()
        for place, (env_id, length) in enumerate(zip(env_ids.tolist(), lengths, strict=True)):
            group = self._group(success[place])
            if group is None or not length or not self._is_whole[env_id]:
                continue
            about = {
                "env": env_id,
                "length": length,
                "last_step": self._env.common_step_counter,
                "success": success[place],
            }
            arrays = {key: rows.of(env_id).copy() for key, rows in {**self._initial, **self._rows}.items()}
            arrays |= {key: value[place : place + 1] for key, value in last.items()}
            self._finished.setdefault(group, []).append((about, arrays))

    def _group(self, success: bool) -> str | None:
        mode = self._options.export_mode
        if mode == "all":
            return "episodes"
        if mode == "succeeded_failed":
            return "succeeded" if success else "failed"
        return "succeeded" if success and mode == "succeeded_only" else None

    def __str__(self) -> str:
        rows = [
            (i, name, ", ".join(_hooks_of(self._hooks, term)), term.target.rsplit(".", 1)[-1])
            for i, (name, term) in enumerate(self._terms.items())
        ]
        return table(f"Recorders: {len(rows)}", ("index", "name", "records", "term"), rows)


def _hooks_of(hooks: Mapping[str, Sequence[tuple[Term, RecorderTerm]]], term: Term) -> list[str]:
    return [hook.removeprefix("record_") for hook, having in hooks.items() if any(t is term for t, _ in having)]


def _joined(episodes: Sequence[tuple[Mapping[str, Any], Arrays]]) -> Arrays:
    """Return the arrays of episodes one after another, with what tells them apart."""
    arrays = {f"episode/{name}": np.array([about[name] for about, _ in episodes]) for name in episodes[0][0]}
    for key in dict.fromkeys(key for _, own in episodes for key in own):
        parts = [own[key] for _, own in episodes if key in own]
        arrays[key] = np.concatenate(parts)
        arrays[f"rows/{key}"] = np.array([len(own.get(key, ())) for _, own in episodes])
    return arrays
