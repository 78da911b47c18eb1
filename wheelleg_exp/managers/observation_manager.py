"""Observations: groups of terms, each modified, corrupted, clipped, scaled and kept as history."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.buffers import HistoryBuffer, RowHistory
from wheelleg_exp.managers.environment import Env
from wheelleg_exp.managers.manager_base import table
from wheelleg_exp.managers.observation_term import ObservationTerm, Values
from wheelleg_exp.managers.term import Term, bind_terms
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.state import Kept, cloned, merged
from wheelleg_exp.terms.sections import ObservationGroup as GroupOptions
from wheelleg_exp.terms.sections import read_section

Group = torch.Tensor | dict[str, torch.Tensor]


class ObservationManager(Kept):
    """Groups of observation terms; ``obs_buf`` holds what ``compute`` returned last.

    Args:
        nodes: the groups by name.
        env: the environment under construction.
    """

    def __init__(self, nodes: Mapping[str, Any], env: Env) -> None:
        self._groups: dict[str, dict[str, ObservationTerm]] = {}
        self._concatenate: dict[str, bool] = {}
        self._rows: dict[str, RowHistory] = {}
        for group, node in nodes.items():
            if node is not None:
                self._add_group(group, node, env)
        self.obs_buf: dict[str, Group] = {}
        self._is_first = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._any_first = False
        self.reset(torch.arange(env.num_envs, device=env.device))

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the terms of each group, in order."""
        return {group: list(terms) for group, terms in self._groups.items()}

    @property
    def bound_terms(self) -> list[Term]:
        """The bound terms of all groups, in order."""
        return [term.term for terms in self._groups.values() for term in terms.values()]

    def terms(self, group: str) -> dict[str, ObservationTerm]:
        """Return the terms of a group by name, in order."""
        return dict(self._groups[group])

    @property
    def group_obs_concatenate(self) -> dict[str, bool]:
        """Whether a group is one tensor."""
        return dict(self._concatenate)

    @property
    def group_obs_term_dim(self) -> dict[str, list[tuple[int, ...]]]:
        """Shape of each term of each group, without the environments."""
        return {group: [term.shape for term in terms.values()] for group, terms in self._groups.items()}

    @property
    def group_obs_dim(self) -> dict[str, tuple[int, ...] | list[tuple[int, ...]]]:
        """Shape of each group: one shape where it is concatenated, else one a term."""
        dims: dict[str, tuple[int, ...] | list[tuple[int, ...]]] = {}
        for group, shapes in self.group_obs_term_dim.items():
            width = sum(shape[-1] for shape in shapes)
            dims[group] = (*shapes[0][:-1], width) if self._concatenate[group] else shapes
        return dims

    def term_slices(self, group: str) -> dict[str, slice]:
        """Return where each term of a concatenated group lies in the last dimension."""
        slices, start = {}, 0
        for name, term in self._groups[group].items():
            slices[name] = slice(start, start + term.shape[-1])
            start += term.shape[-1]
        return slices

    def split(self, group: str, value: Group) -> dict[str, torch.Tensor]:
        """Return a group's observation term by term."""
        if not isinstance(value, torch.Tensor):
            return value
        return {name: value[..., part] for name, part in self.term_slices(group).items()}

    def compute(self, only: torch.Tensor | None = None) -> dict[str, Group]:
        """Return every group's observation; advances noise, modifiers and histories.

        Args:
            only: environments (N,) bool that are observed anew: the others' observations, modifiers and histories stay
                as they are.
        """
        kept = None if only is None else self.state_dict()
        first = self._first_ids()
        values: Values = {}
        self.obs_buf = {group: self._computed(group, first, values) for group in self._groups}
        if self._any_first:
            self._is_first.fill_(False)
            self._any_first = False
        if only is not None:
            self.load_state_dict(merged(kept, self.state_dict(), only))
        return self.obs_buf

    def peek(self) -> dict[str, Group]:
        """Return what ``compute`` would, without noise and without changing any state."""
        first = self._first_ids()
        found: dict[str, Group] = {}
        for group, terms in self._groups.items():
            shown = {name: term.peek() for name, term in terms.items()}
            row = self._rows.get(group)
            if row is not None:
                found[group] = row.appended(list(shown.values()), first)
                continue
            for name, term in terms.items():
                if isinstance(term.history, HistoryBuffer):
                    shown[name] = term.shown(term.history.appended(shown[name], first))
            found[group] = self._joined(group, shown)
        return found

    def _first_ids(self) -> torch.Tensor | None:
        return ids_where(self._is_first) if self._any_first else None

    def reset(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Reset every term of ``env_ids``."""
        for terms in self._groups.values():
            for term in terms.values():
                term.reset(env_ids)
        self._is_first[env_ids] = True
        self._any_first = True
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return the state of every term and the last observation."""
        terms = {g: {n: t.state_dict() for n, t in ts.items()} for g, ts in self._groups.items()}
        return {"groups": terms, "obs_buf": cloned(self.obs_buf), "is_first": self._is_first.clone()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for group, terms in self._groups.items():
            for name, term in terms.items():
                term.load_state_dict(saved["groups"][group][name])
        self.obs_buf = cloned(saved["obs_buf"])
        self._is_first.copy_(saved["is_first"])
        self._any_first = bool(self._is_first.any())

    def _add_group(self, group: str, node: Mapping[str, Any], env: Env) -> None:
        path = f"env.observations.{group}"
        options = read_section(GroupOptions, node, path)
        terms = bind_terms("observations", f"{path}.terms", options.terms, env)
        if not terms:
            raise ConfigError("the group has no terms", key=f"{path}.terms", expected="at least one term")
        self._concatenate[group] = options.concatenate_terms
        self._groups[group] = {}
        for name, term in terms.items():
            length, flatten = options.history_length, options.flatten_history_dim
            if length is None:  # a group's own history setting overrides its terms'
                length = term.fields.get("history_length", 0)
                flatten = term.fields.get("flatten_history_dim", True)
            self._groups[group][name] = ObservationTerm(term, env, options.enable_corruption, length, flatten)
        shapes = {t.shape[:-1] for t in self._groups[group].values()}
        if self._concatenate[group] and len(shapes) > 1:
            raise ConfigError(
                f"terms with histories of different shape {sorted(shapes)} cannot stand in one vector",
                key=f"{path}.terms",
                expected="one history_length and flatten_history_dim for all, or concatenate_terms: false",
            )
        self._add_histories(group, env)
        others = [term for known, terms in self._groups.items() if known != group for term in terms.values()]
        for one in self._groups[group].values():
            one.share(others)

    def _add_histories(self, group: str, env: Env) -> None:
        """Make the histories: one row for all terms where the group is one, else a buffer for each term."""
        terms = list(self._groups[group].values())
        if self._concatenate[group] and all(len(term.shape) == 1 for term in terms):
            widths, lengths = [term.width for term in terms], [term.history_length for term in terms]
            row = self._rows[group] = RowHistory(env.num_envs, widths, lengths, env.device)
            for index, term in enumerate(terms):
                term.history = row.part(index) if term.history_length else None
            return
        for term in terms:
            if term.history_length:
                shape = torch.Size((term.width,))
                term.history = HistoryBuffer(env.num_envs, term.history_length, shape, env.device)

    def _computed(self, group: str, first: torch.Tensor | None, values: Values) -> Group:
        """Advance one group by a sample, and return its observation."""
        terms = self._groups[group]
        row = self._rows.get(group)
        if row is not None:
            return row.append([term.sample(values) for term in terms.values()], first)
        shown = {}
        for name, term in terms.items():
            shown[name] = term.sample(values)
            if isinstance(term.history, HistoryBuffer):
                shown[name] = term.shown(term.history.append(shown[name], first))
            shown[name] = shown[name].clone()
        return self._joined(group, shown)

    def _joined(self, group: str, values: dict[str, torch.Tensor]) -> Group:
        return torch.cat(list(values.values()), dim=-1) if self._concatenate[group] else values

    def __str__(self) -> str:
        parts = []
        for group, terms in self._groups.items():
            rows = [
                (i, name, term.shape, term.term.fields.get("scale", "-"), term.term.target.rsplit(".", 1)[-1])
                for i, (name, term) in enumerate(terms.items())
            ]
            title = f"Observations '{group}': {self.group_obs_dim[group]}"
            parts.append(table(title, ("index", "name", "shape", "scale", "term"), rows))
        return "\n".join(parts)
