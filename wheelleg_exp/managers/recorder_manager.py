"""Recorders: save each episode as part of a dataset. Recorders only read the environment and never change it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch

from wheelleg_exp.constraints import Terms
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.machine import require_memory
from wheelleg_exp.managers.manager_base import ManagerBase, Term, TermBase
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.terms.config_sections import Dataset
from wheelleg_exp.terms.term_errors import code_place, described

Recorded = tuple[str | None, torch.Tensor | Mapping[str, object] | None]
Arrays = dict[str, np.ndarray]
_SUCCESS = "success"  # An episode that the termination `success` ends is a success.
_OWN = ("episode", "rows")  # Keys of recorder terms cannot start with ``episode/`` or ``rows/``.


class Rows:
    """Stores a recorded quantity as rows (N, …), and deletes rows that are older than all current episodes."""

    def __init__(self, num_envs: int) -> None:
        self._rows: list[np.ndarray] = []
        self._starts = np.zeros(num_envs, dtype=np.int64)

    def append(self, value: np.ndarray, owner: str) -> None:
        """Append a copy of ``value`` (N, …) as a new row. Errors contain ``owner``, the recorder term's config key."""
        if self._rows and value.shape != self._rows[0].shape:
            message = f"the recorded shape is {value.shape}, and was {self._rows[0].shape}"
            raise ConfigError(message, key=owner, expected="the same shape at every call")
        first = int(self._starts.min())
        del self._rows[:first]
        self._starts -= first
        self._rows.append(value.copy())

    def of(self, env_id: int) -> np.ndarray:
        """Return one environment's recorded rows of its current episode, (T, …) for T rows."""
        rows = [row[env_id] for row in self._rows[self._starts[env_id] :]]
        return np.stack(rows) if rows else self._rows[0][:0]

    def begin(self, ids: np.ndarray) -> None:
        """Assign the rows recorded from now on to new episodes in the environments ``ids``."""
        self._starts[ids] = len(self._rows)


def recorded_arrays(returned: object, rows: int, source: str, code: object) -> Arrays:
    """Return the tensors from a recorder as arrays by key, or by ``key/name``; errors name ``source`` and ``code``."""
    arrays, found = {}, described(returned)
    if isinstance(returned, tuple) and len(returned) == 2:
        for key, value in () if returned[1] is None else _flatten(*returned):
            if not isinstance(key, str) or not isinstance(value, torch.Tensor) or value.shape[:1] != (rows,):
                found = f"{described(key)} and {described(value)}"
                break
            arrays[key] = value.detach().cpu().numpy()
        else:
            return arrays
    expected = f"a key, and a tensor of shape ({rows}, ...) or such tensors by name; or None, None"
    raise ConfigError(f"{source} returns {found}", where=code_place(code), expected=expected)


def _flatten(key: object, value: object) -> Iterator[tuple[object, object]]:
    if not isinstance(value, Mapping):
        yield key, value
        return
    for name, item in value.items():
        yield from _flatten(f"{key}/{name}", item)


class RecorderTerm(TermBase):
    """Records quantities by key. A subclass of the recorder class overrides only the hooks that the subclass needs.

    A recorder's hook returns a key and a tensor with one row for each environment, or a key and a mapping of tensors.
    For example, the key ``a`` with the mapping ``{"b": tensor}`` records the tensor as ``a/b``. A hook returns (None,
    None) if it records nothing.
    """

    # Whether ``record_post_step`` reads ``obs_buf``, which then holds the observations before resets, without noise.
    reads_observations: ClassVar[bool] = True

    def __init__(self, env: Env) -> None:
        self._env = env

    def record_pre_step(self) -> Recorded:
        """Return quantities to record before an action; ``obs_buf`` has the observations before the action."""
        return None, None

    def record_post_physics_decimation_step(self) -> Recorded:
        """Return quantities to record after a physics step, before sensors are read."""
        return None, None

    def record_post_step(self) -> Recorded:
        """Return quantities to record at the end of a control step, before environments are reset."""
        return None, None

    def record_pre_reset(self, env_ids: torch.Tensor) -> Recorded:  # noqa: ARG002
        """Return quantities to record at the end of the episodes of ``env_ids``, with one row per environment."""
        return None, None

    def record_post_reset(self, env_ids: torch.Tensor) -> Recorded:  # noqa: ARG002
        """Return quantities to record at the start of the new episodes of ``env_ids``, with one row per environment."""
        return None, None


class RecorderManager(ManagerBase):
    """Splits recorded rows into episodes, and passes finished episodes to the writer of the dataset.

    A dataset holds complete episodes, so an episode in which a state was loaded is omitted. Recorded rows are not
    state: a checkpoint is the same with and without recorders. In Gymnasium's autoreset mode ``next_step``, the extra
    step that resets an environment is the episode's last step.
    """

    kind = "recorders"
    columns = ("records",)

    def __init__(self, nodes: Terms, options: Dataset, env: Env) -> None:
        super().__init__(nodes, env)
        self._options = options
        for term in self._terms.values():
            if not isinstance(term.func, RecorderTerm):
                expected = "a subclass of RecorderTerm"
                raise ConfigError(f"'{term.target}' is not the class of a recorder", key=term.path, expected=expected)
        self._hooks: dict[str, list[tuple[Term, RecorderTerm]]] = {}
        for hook in (name for name in vars(RecorderTerm) if name.startswith("record_")):
            pairs: Any = [(term, term.func) for term in self._terms.values()]
            own = getattr(RecorderTerm, hook)
            self._hooks[hook] = [(t, f) for t, f in pairs if getattr(type(f), hook) is not own]
        self._reads = any(t.reads_observations for _, t in self._hooks["record_post_step"])
        # A checkpoint contains no recorded rows: a resumed training records whole episodes only.
        self._rows: dict[str, Rows] = self.number("_rows", {}, saved=False)
        self._initial: Arrays = self.number("_initial", {}, saved=False)  # a row for each environment
        self._owners: dict[str, str] = self.number("_owners", {}, saved=False)
        self._is_whole = self.number("_is_whole", np.zeros(self._num_envs, dtype=bool), saved=False)
        self._finished: dict[str, list[tuple[dict[str, int], Arrays]]] = self.number("_finished", {}, saved=False)

    def record_pre_step(self) -> None:
        """Call all recorders before the environment applies the action."""
        self._append("record_pre_step")

    def record_post_physics_decimation_step(self) -> None:
        """Record after a physics step."""
        self._append("record_post_physics_decimation_step")

    def record_post_step(self) -> None:
        """Call all recorders after rewards and terminations were computed, before environments are reset."""
        manager = self._env.observation_manager
        present = manager.obs_buf
        if self._reads:
            manager.obs_buf = manager.peek()
        try:
            self._append("record_post_step")
        finally:
            manager.obs_buf = present

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        """Finish the episodes in ``env_ids``, but drop episodes without a step or without a recorded start."""
        mode, ends = self._options.export_mode, self._env.termination_manager
        if not self._terms or mode == "none":
            return
        last = self._only("record_pre_reset", env_ids)
        success = [False] * len(env_ids)
        if _SUCCESS in ends.active_terms:
            success = ends.get_term(_SUCCESS)[env_ids].tolist()
        lengths = self._env.episode_length_buf[env_ids].tolist()
        for place, (env_id, length) in enumerate(zip(env_ids.tolist(), lengths, strict=True)):
            group = "episodes" if mode == "all" else "succeeded" if success[place] else "failed"
            is_wanted = success[place] or mode != "succeeded_only"
            if not is_wanted or not length or not self._is_whole[env_id]:
                continue
            last_step = self._env.common_step_counter
            about = {"env": env_id, "length": length, "last_step": last_step, "success": success[place]}
            arrays = {key: value[env_id : env_id + 1].copy() for key, value in self._initial.items()}
            arrays |= {key: rows.of(env_id) for key, rows in self._rows.items()}
            arrays |= {key: value[place : place + 1] for key, value in last.items()}
            self._finished.setdefault(group, []).append((about, arrays))

    def record_post_reset(self, env_ids: torch.Tensor) -> None:
        """Start the episodes of ``env_ids``."""
        if not self._terms:
            return
        ids = env_ids.cpu().numpy()
        for key, value in self._only("record_post_reset", env_ids).items():
            self._initial.setdefault(key, np.zeros((self._num_envs, *value.shape[1:]), value.dtype))[ids] = value

    def reset(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Start new episodes of the environments ``env_ids``; return an empty log."""
        if self._terms:
            ids = env_ids.cpu().numpy()
            for rows in self._rows.values():
                rows.begin(ids)
            self._is_whole[ids] = True
            self._reset_terms(env_ids)
        return {}

    def close(self) -> None:
        """Finish the current episodes, if ``env.dataset.export_in_close`` is set."""
        if self._options.export_in_close:
            self.record_pre_reset(torch.arange(self._num_envs, device=self._env.device))
            self._is_whole[:] = False

    def take(self) -> dict[str, Arrays]:
        """Return a dictionary ``{group: {name: array}}`` of the episodes that ended since the last call of ``take``.

        With ``export_mode: all``, the only group is ``episodes``; otherwise, the groups are ``succeeded`` and
        ``failed``. ``episode/env``, ``episode/length``, ``episode/last_step`` (control steps of the environment so
        far), and ``episode/success`` have one number per episode. Each recorded quantity is one array with the rows of
        all episodes; ``rows/<key>`` has the number of rows per episode.
        """
        found = {group: _joined(episodes) for group, episodes in self._finished.items()}
        self._finished = {}
        return found

    def forget(self) -> None:
        """Omit current episodes from the dataset; after a state was loaded, their first steps are missing."""
        self._is_whole[:] = False

    def state_dict(self) -> dict[str, object]:
        states = {name: term.state_dict() for name, term in self._terms.items()}
        present = {name: state for name, state in states.items() if state["settings"] or state["object"]}
        return {"terms": present} if present else {}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        for name, state in saved.get("terms", {}).items():
            self._terms[name].load_state_dict(state)

    def _recorded(self, hook: str, rows: int, *args: torch.Tensor) -> Iterator[tuple[str, np.ndarray]]:
        for term, recorder in self._hooks[hook]:
            with term.blamed():
                found = recorded_arrays(getattr(recorder, hook)(*args), rows, f"'{term.target}.{hook}'", recorder)
                for key in found:
                    first = self._owners.setdefault(key, term.path)
                    if first != term.path:
                        message = f"the key '{key}' is already recorded by term {first}"
                        raise ConfigError(message, expected="a key for each quantity")
                    if key.split("/")[0] in _OWN:
                        message = f"the key '{key}' is reserved for data about episodes"
                        raise ConfigError(message, expected="another key")
            yield from found.items()

    def _append(self, hook: str) -> None:
        if not self._hooks[hook]:
            return
        for name, array in self._recorded(hook, self._num_envs):
            if name not in self._rows:
                what = f"{self._env.max_episode_length} steps of '{name}' of {self._num_envs} environments"
                require_memory(array.nbytes * self._env.max_episode_length, self._owners[name], what)
                self._rows[name] = Rows(self._num_envs)
            self._rows[name].append(array, self._owners[name])

    def _only(self, hook: str, env_ids: torch.Tensor) -> Arrays:
        return {name: array.copy() for name, array in self._recorded(hook, len(env_ids), env_ids)}

    def _cells(self, term: Term) -> tuple[object, ...]:
        hooks = [hook for hook, having in self._hooks.items() if any(owner is term for owner, _ in having)]
        return (", ".join(hook.removeprefix("record_") for hook in hooks),)


def _joined(episodes: Sequence[tuple[Mapping[str, object], Arrays]]) -> Arrays:
    arrays = {f"episode/{name}": np.array([about[name] for about, _ in episodes]) for name in episodes[0][0]}
    for key in dict.fromkeys(key for _, own in episodes for key in own):
        arrays[key] = np.concatenate([own[key] for _, own in episodes if key in own])
        arrays[f"rows/{key}"] = np.array([len(own.get(key, ())) for _, own in episodes])
    return arrays
