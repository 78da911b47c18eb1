"""Observations: groups of terms, each modified, corrupted, clipped, scaled and kept as history."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.buffers import HistoryBuffer
from wheelleg_exp.managers.environment import Env
from wheelleg_exp.managers.failures import failure, require_form
from wheelleg_exp.managers.manager_base import table
from wheelleg_exp.managers.returned import row_form
from wheelleg_exp.managers.term import Term, bind_terms
from wheelleg_exp.memory import require_memory
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.state import Kept, cloned, made, merged, stateful
from wheelleg_exp.terms.sections import ObservationGroup as GroupOptions
from wheelleg_exp.terms.sections import read_section

Group = torch.Tensor | dict[str, torch.Tensor]


class ObservationTerm(Kept):
    """One term of a group: ``func -> modifiers -> noise -> clip -> scale -> history``.

    Args:
        term: the bound term.
        env: the environment.
        corrupt: whether the group lets noise act.
        history_length: samples kept; 0 is none.
        flatten: whether the history is flattened, oldest first.
    """

    def __init__(self, term: Term, env: Env, corrupt: bool, history_length: int, flatten: bool) -> None:
        self.term = term
        self._env = env
        modifiers = term.fields.get("modifiers") or []
        if not isinstance(modifiers, list):
            raise ConfigError("is no list", key=f"{term.path}.modifiers", expected="[{_target_: ...}, ...]")
        self._modifiers: list[Any] = list(modifiers)
        self._noise: Any = term.fields.get("noise") if corrupt else None
        self._generator = env.streams.get(f"{term.path}.noise")
        clip = term.fields.get("clip")
        self._clip = None if clip is None else (float(clip[0]), float(clip[1]))
        self._require_callables()
        self._flatten = flatten
        term.form = row_form(env.num_envs, env.device)
        sample = term(env)
        self._scale = self._scale_tensor(term.fields.get("scale"), sample.shape[1])
        for number, modifier in enumerate(self._modifiers):
            modifier.start(sample)
            made(modifier, f"{term.path}.modifiers[{number}]")
        self._noise_state = stateful(self._noise, f"{term.path}.noise")
        what = f"histories of {history_length} steps of {env.num_envs} environments"
        require_memory(4 * sample.numel() * history_length, term.path, what)
        self.history = (
            HistoryBuffer(env.num_envs, history_length, sample.shape[1:], env.device) if history_length > 0 else None
        )
        self.history_length = history_length
        self.width = int(sample.shape[1])
        self._part_forms = {
            name: dataclasses.replace(term.form, width=self.width)
            for name in ("noise", *(f"modifiers[{number}]" for number in range(len(self._modifiers))))
        }
        self.shape = (
            (self.width,)
            if not self.history
            else ((self.width * history_length,) if flatten else (history_length, self.width))
        )

    def compute(self, first: torch.Tensor | None) -> torch.Tensor:
        """Draw noise, advance modifiers and history, and return the term's observation.

        Args:
            first: environments at the first observation of an episode, or None.
        """
        value = self._sample(draw=True)
        if self.history is None:
            return value.clone()
        samples = self.history.append(value, first)
        return samples.flatten(1) if self._flatten else samples.clone()

    def peek(self, first: torch.Tensor | None) -> torch.Tensor:
        """Return what ``compute`` would, without noise and without changing any state."""
        owners = [*self._modifiers, *([self.term.stateful] if self.term.stateful is not None else [])]
        kept = [owner.state_dict() for owner in owners]
        stream = None if self.term.generator is None else self.term.generator.get_state()
        value = self._sample(draw=False).clone()
        for owner, state in zip(owners, kept, strict=True):
            owner.load_state_dict(state)
        if self.term.generator is not None and stream is not None:
            self.term.generator.set_state(stream)
        if self.history is None:
            return value
        samples = self.history.appended(value, first)
        return samples.flatten(1) if self._flatten else samples

    def parts(self) -> dict[str, Any]:
        """Return the modifiers and the noise by their keys."""
        found = {f"modifiers[{number}]": modifier for number, modifier in enumerate(self._modifiers)}
        return found | ({} if self._noise is None else {"noise": self._noise})

    def reset(self, env_ids: torch.Tensor) -> None:
        """Reset the term object, modifiers and noise of ``env_ids``; histories refill with the next sample."""
        if self.term.stateful is not None:
            self.term.stateful.reset(env_ids)
        for modifier in self._modifiers:
            modifier.reset(env_ids)
        if hasattr(self._noise, "reset"):
            self._noise.reset(env_ids, self._generator)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of everything that survives a step."""
        state: dict[str, Any] = {
            "modifiers": [modifier.state_dict() for modifier in self._modifiers],
            "term": self.term.state_dict(),
            "noise": self._noise_state.state_dict(),
        }
        if self.history is not None:
            state["history"] = self.history.state_dict()
        return state

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for modifier, state in zip(self._modifiers, saved["modifiers"], strict=True):
            modifier.load_state_dict(state)
        self.term.load_state_dict(saved["term"])
        self._noise_state.load_state_dict(saved["noise"])
        if self.history is not None:
            self.history.load_state_dict(saved["history"])

    def _sample(self, *, draw: bool) -> torch.Tensor:
        value = self.term(self._env)
        for number, modifier in enumerate(self._modifiers):
            value = self._part(f"modifiers[{number}]", modifier, value)
        if draw and self._noise is not None:
            value = self._part("noise", self._noise, value, self._generator)
        if self._clip is not None:
            value = value.clip(self._clip[0], self._clip[1])
        return value if self._scale is None else value * self._scale

    def _part(self, name: str, part: Any, *args: Any) -> torch.Tensor:
        """Call a modifier or the noise; what is wrong with it is told under its own key."""
        path, target = f"{self.term.path}.{name}", f"{type(part).__module__}.{type(part).__qualname__}"
        try:
            value = part(*args)
        except BaseException as error:
            raise failure(error, path, target, part, has_worked=self._part_forms[name].is_known) from error
        require_form(self._part_forms[name], value, f"'{target}'", path, part)
        return value

    def _require_callables(self) -> None:
        for name, parts, method in (("modifiers", self._modifiers, "start"), ("noise", [self._noise], "__call__")):
            for part in parts:
                if part is not None and not hasattr(part, method):
                    kind = type(part)
                    what = repr(part) if kind.__module__ == "builtins" else f"'{kind.__module__}.{kind.__qualname__}'"
                    raise ConfigError(
                        f"{what} has no {method}()",
                        key=f"{self.term.path}.{name}",
                        expected=f"a _target_ of wheelleg_exp.mdp.{name}, or a class of yours that is like one",
                    )

    def _scale_tensor(self, scale: Any, width: int) -> torch.Tensor | float | None:
        if scale is None or isinstance(scale, (int, float)):
            return scale
        if len(scale) != width:
            raise ConfigError(
                f"has {len(scale)} numbers for a term of width {width}",
                key=f"{self.term.path}.scale",
                expected=f"one number or {width}",
            )
        return torch.tensor(scale, dtype=torch.float32, device=self._env.device)


class ObservationManager(Kept):
    """Groups of observation terms; ``obs_buf`` holds what ``compute`` returned last.

    Args:
        nodes: the groups by name.
        env: the environment under construction.
    """

    def __init__(self, nodes: Mapping[str, Any], env: Env) -> None:
        self._groups: dict[str, dict[str, ObservationTerm]] = {}
        self._concatenate: dict[str, bool] = {}
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
        self.obs_buf = {
            group: self._joined(group, {name: term.compute(first) for name, term in terms.items()})
            for group, terms in self._groups.items()
        }
        if self._any_first:
            self._is_first.fill_(False)
            self._any_first = False
        if only is not None:
            self.load_state_dict(merged(kept, self.state_dict(), only))
        return self.obs_buf

    def peek(self) -> dict[str, Group]:
        """Return what ``compute`` would, without noise and without changing any state."""
        first = self._first_ids()
        return {
            group: self._joined(group, {name: term.peek(first) for name, term in terms.items()})
            for group, terms in self._groups.items()
        }

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
