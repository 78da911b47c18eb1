"""Observations: groups of terms with modifiers, noise, clipping, scaling, and histories."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.machine import require_memory
from wheelleg_exp.managers.manager_base import Term, bind_terms, table
from wheelleg_exp.managers.observation_term import Group, GroupLayout, ObservationTerm, Values
from wheelleg_exp.managers.sample_history import HistoryBuffer, RowHistory
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.state import Stateful, cloned
from wheelleg_exp.terms.config_sections import ObservationGroup as GroupOptions

_SLICE = 100  # bytes per slice object


class ObservationManager(Stateful):
    """Groups of observation terms. ``obs_buf`` contains the observations that ``compute`` returned last, by group."""

    def __init__(self, groups: Mapping[str, GroupOptions], env: Env) -> None:
        self._groups: dict[str, dict[str, ObservationTerm]] = self.child("_groups", {}, saved=False)
        self._layouts: dict[str, GroupLayout] = {}
        self._rows: dict[str, RowHistory] = self.child("_rows", {}, saved=False)
        for group, options in groups.items():
            self._add_group(group, options, env)
        self._late = [t for terms in self._groups.values() for t in terms.values() if t.delay is not None]
        self.obs_buf: dict[str, Group] = self.buffer("obs_buf", {}, saved=False)
        is_first = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._is_first = self.buffer("_is_first", is_first)
        self._any_first = self.number("_any_first", False, saved=False)
        self.in_masks = False  # CUDA graphs require ``in_masks`` = True: masks, not indices, select environments.
        self.reset(torch.arange(env.num_envs, device=env.device))

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the observation terms by group, in the order of the config."""
        return {group: list(terms) for group, terms in self._groups.items()}

    @property
    def bound_terms(self) -> list[Term]:
        """The bound observation terms of all groups, in the order of the config."""
        return [term.term for terms in self._groups.values() for term in terms.values()]

    def terms(self, group: str) -> dict[str, ObservationTerm]:
        """Return the observation terms of a group by name, in the order of the config."""
        return dict(self._groups[group])

    @property
    def group_obs_concatenate(self) -> dict[str, bool]:
        """Whether the observations of a group's terms are concatenated, by group."""
        return {group: layout.concatenated for group, layout in self._layouts.items()}

    @property
    def group_obs_term_dim(self) -> dict[str, list[tuple[int, ...]]]:
        """Shapes of the observation terms, as one list per group; shapes omit the dimension of the environments."""
        return {group: [term.shape for term in terms.values()] for group, terms in self._groups.items()}

    @property
    def group_obs_dim(self) -> dict[str, tuple[int, ...] | list[tuple[int, ...]]]:
        """Shape of each group: one shape if the group is concatenated, otherwise one for each term."""
        return {group: layout.shape for group, layout in self._layouts.items()}

    def term_parts(self, group: str) -> dict[str, list[slice]]:
        """Return each term's slices of a group: one, or with ``history_order: time`` one a step, oldest first."""
        return dict(self._layouts[group].parts)

    def term_slices(self, group: str) -> dict[str, slice]:
        """Return each term's slice of a group's observation; raise ValueError if a term has more than one slice."""
        parts = self.term_parts(group)
        if any(len(found) > 1 for found in parts.values()):
            raise ValueError(f"with history_order 'time', a term of observation group '{group}' has a slice per step")
        return {name: found[0] for name, found in parts.items()}

    def part(self, group: str, term: str, value: Group) -> torch.Tensor:
        """Return the part of the group observation ``value`` that belongs to the term ``term``."""
        return self._layouts[group].part(term, value)

    def split(self, group: str, value: Group) -> dict[str, torch.Tensor]:
        """Split the observation of a group into the observations of its terms, by name."""
        return {name: self.part(group, name, value) for name in self._groups[group]}

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[float]]]:
        """Return the last observation of one environment by term, with names such as ``<group>-<term>``."""
        split = {group: self.split(group, value) for group, value in self.obs_buf.items()}
        shown = {f"{group}-{name}": value for group, values in split.items() for name, value in values.items()}
        return [(name, value[env_idx].flatten().tolist()) for name, value in shown.items()]

    def sample_between(self) -> None:
        """Sample all observation terms with a delay; the environment calls this method between two physics steps."""
        for term in self._late:
            term.sample_between()

    def compute(self, only: torch.Tensor | None = None) -> dict[str, Group]:
        """Return the observation of every group, and advance the terms' noise, modifiers, and histories.

        If the mask ``only`` (N,) bool is given, noise, modifiers, and histories advance only in its environments.
        """
        before = None if only is None else self.state_dict()
        first, values = self._first_ids(), Values()
        self.obs_buf = {  # Copy a sample before the next term runs, which may reuse its tensor.
            group: self._with_histories(group, (term.sample(values) for term in terms.values()), first, keep=True)
            for group, terms in self._groups.items()
        }
        if self._any_first:
            self._is_first.fill_(False)
            self._any_first = False
        if only is not None:
            self.load_state_dict(_merged(before, self.state_dict(), only))
        return self.obs_buf

    def peek(self) -> dict[str, Group]:
        """Return the observations of all groups without noise; do not change any state."""
        first, samples = self._first_ids(), {g: [t.peek() for t in ts.values()] for g, ts in self._groups.items()}
        return {group: self._with_histories(group, samples[group], first, keep=False) for group in samples}

    def _first_ids(self) -> torch.Tensor | None:
        if not self._any_first:
            return None
        return self._is_first if self.in_masks else ids_where(self._is_first)

    def reset(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Reset every term of ``env_ids``."""
        for terms in self._groups.values():
            for term in terms.values():
                term.reset(env_ids)
        self._is_first.index_fill_(0, env_ids, True)
        self._any_first = True
        return {}

    def state_dict(self) -> dict[str, object]:
        terms = {g: {n: t.state_dict() for n, t in ts.items()} for g, ts in self._groups.items()}
        return {"groups": terms, "obs_buf": cloned(self.obs_buf), **super().state_dict()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        super().load_state_dict(saved)
        for group, terms in self._groups.items():
            for name, term in terms.items():
                term.load_state_dict(saved["groups"][group][name])
        self.obs_buf = cloned(saved["obs_buf"])
        self._any_first = bool(self._is_first.any())

    def _add_group(self, group: str, options: GroupOptions, env: Env) -> None:
        path = f"env.observations.{group}"
        terms: dict[str, ObservationTerm] = {}
        for name, bound in bind_terms("observations", f"{path}.terms", options.terms, env).items():
            length, flatten = options.history_length, options.flatten_history_dim
            if length is None:  # The history settings of an observation group override those of its terms.
                length = bound.fields.get("history_length", 0)
                flatten = bound.fields.get("flatten_history_dim", True)
            terms[name] = ObservationTerm(bound, env, options.enable_corruption, length, flatten)
            terms[name].share(other for known in self._groups.values() for other in known.values())
        if not terms:
            raise ConfigError("the observation group has no terms", key=f"{path}.terms", expected="at least one term")
        key = f"{path}.history_length" if options.history_length else ""
        _require_memory(list(terms.values()), env, key, by_time=options.history_order == "time")
        self._groups[group], self._layouts[group] = terms, GroupLayout(terms, options, path)
        is_plain = all(len(term.shape) == len(term.sample_shape) == 1 for term in terms.values())
        row = None
        if self._layouts[group].concatenated and is_plain and not self._layouts[group].by_time:
            sizes = [term.width for term in terms.values()], [term.history_length for term in terms.values()]
            row = self._rows[group] = RowHistory(env.num_envs, *sizes, env.device)
        for index, term in enumerate(terms.values()):
            if term.history_length and row is not None:
                term.history = row.part(index)
            elif term.history_length:
                term.history = HistoryBuffer(env.num_envs, term.history_length, term.sample_shape, env.device)

    def _with_histories(
        self, group: str, samples: Iterable[torch.Tensor], first: torch.Tensor | None, *, keep: bool
    ) -> Group:
        """Return the observation of a group from a sample of each term; if ``keep``, store the samples in histories."""
        row = self._rows.get(group)
        if row is not None:
            return row.append([*samples], first) if keep else row.appended([*samples], first)
        shown = {}
        for (name, term), sample in zip(self._groups[group].items(), samples, strict=True):
            if isinstance(term.history, HistoryBuffer):
                history = term.history.append(sample, first) if keep else term.history.appended(sample, first)
                sample = self._layouts[group].shown(term, history)
            shown[name] = sample.clone()
        return self._layouts[group].join(shown)

    def __str__(self) -> str:
        parts, columns = [], ("index", "name", "shape", "scale", "term")
        for group, terms in self._groups.items():
            last = [(t.term.fields.get("scale", "-"), t.term.target.rsplit(".", 1)[-1]) for t in terms.values()]
            rows = [(i, name, term.shape, *last[i]) for i, (name, term) in enumerate(terms.items())]
            parts.append(table(f"Observations '{group}': {self.group_obs_dim[group]}", columns, rows))
        return "\n".join(parts)


def _merged(before: object, after: Any, rows: torch.Tensor) -> Any:
    """Return a state dict with the environments ``rows`` (N,) bool of ``after``, and the other ones of ``before``.

    Values without one row per environment, such as plain numbers, come from ``after``.
    """
    if isinstance(after, Mapping) and isinstance(before, Mapping):
        return {name: _merged(before.get(name), item, rows) for name, item in after.items()}
    if isinstance(after, (list, tuple)) and isinstance(before, (list, tuple)) and len(before) == len(after):
        return type(after)(_merged(old, new, rows) for old, new in zip(before, after, strict=True))
    if isinstance(after, torch.Tensor) and isinstance(before, torch.Tensor):
        has_rows = before.shape == after.shape and after.shape[:1] == rows.shape
        return torch.where(rows.view(-1, *[1] * (after.ndim - 1)), after, before) if has_rows else after
    return after


def _require_memory(terms: list[ObservationTerm], env: Env, key: str, *, by_time: bool) -> None:
    """Raise ConfigError if the observation histories do not fit into memory."""
    longest = max(terms, key=lambda term: term.history_length)
    lengths = [max(1, term.history_length) for term in terms]
    numbers = sum(term.width * length for term, length in zip(terms, lengths, strict=True))
    # Each number in a history takes 8 bytes per environment, and 16 bytes for two indices.
    need = numbers * (8 * env.num_envs + 16) + (_SLICE * sum(lengths) if by_time else 0)
    what = f"histories of {longest.history_length} steps of {env.num_envs} environments"
    require_memory(need, key or longest.term.path, what)
