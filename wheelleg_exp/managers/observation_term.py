"""Observation terms: from the function to the sample, and how the terms of a group are joined."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.manager_base import Term
from wheelleg_exp.managers.return_checks import require_form, row_form
from wheelleg_exp.managers.sample_history import HistoryBuffer, RowHistoryPart, made_delay
from wheelleg_exp.managers.term_interface import Env, SceneEntityCfg
from wheelleg_exp.state import Stateful
from wheelleg_exp.terms.config_sections import ObservationGroup as GroupOptions
from wheelleg_exp.terms.term_errors import blamed, dotted_name


@dataclass
class Values:
    """The functions' results (``raw``) and the ``samples`` of a control step, so that equal terms are computed once."""

    raw: dict[ObservationTerm, torch.Tensor] = field(default_factory=dict)
    samples: dict[ObservationTerm, torch.Tensor] = field(default_factory=dict)


class ObservationTerm(Stateful):
    """One observation term, computed in the order ``func -> delay -> modifiers -> noise -> clip -> scale -> history``.

    ``corrupt``, the group's setting ``enable_corruption``, turns noise on. ``history_length`` 0 means no history.
    """

    def __init__(self, term: Term, env: Env, corrupt: bool, history_length: int, flatten: bool) -> None:
        self.term = self.child("term", term)
        self.path = term.path
        self._env = env
        modifiers = term.fields.get("modifiers") or []
        if not isinstance(modifiers, list):
            message = "modifiers is not a list"
            raise ConfigError(message, key=f"{term.path}.modifiers", expected="[{_target_: ...}, ...]")
        self._modifiers: list[Any] = self.child("_modifiers", list(modifiers))
        self._noise: Any = self.child("_noise", term.fields.get("noise") if corrupt else None)
        self._generator = env.streams.get(f"{term.path}.noise")
        clip = term.fields.get("clip")
        pair = None if clip is None else (float(clip[0]), float(clip[1]))
        self._clip = self.number("_clip", pair, saved=False)
        for name, parts, method in (("modifiers", self._modifiers, "start"), ("noise", [self._noise], "__call__")):
            for part in parts:
                if part is not None and not hasattr(part, method):
                    kind = type(part)
                    what = repr(part) if kind.__module__ == "builtins" else f"'{kind.__module__}.{kind.__qualname__}'"
                    expected = f"a _target_ of wheelleg_exp.mdp.{name}, or a user-defined class with {method}()"
                    raise ConfigError(f"{what} has no {method}()", key=f"{self.term.path}.{name}", expected=expected)
        self._flatten = flatten
        term.form = row_form(env.num_envs, env.device, deep=True)
        sample = term(env)
        scale, width = term.fields.get("scale"), sample.shape[-1]
        if scale is not None and not isinstance(scale, (int, float)):
            if len(scale) != width:
                message = f"scale has {len(scale)} numbers for a term of width {width}"
                raise ConfigError(message, key=f"{term.path}.scale", expected=f"one number or {width}")
            scale = torch.tensor(scale, dtype=torch.float32, device=env.device)
        self._scale: torch.Tensor | float | None = self.number("_scale", scale, saved=False)
        self.delay = self.child("delay", made_delay(term, sample, env, env.exact_envs))
        for modifier in self._modifiers:
            modifier.start(sample)
        self.history: HistoryBuffer | RowHistoryPart | None = self.child("history", None)
        self.same_as: ObservationTerm | None = None
        self._when_shared: list[tuple[Mapping[str, object], Mapping[str, object]]] = []
        self._same_sample = False
        self.history_length = history_length
        self.sample_shape = tuple(sample.shape[1:])
        self.width = math.prod(self.sample_shape)
        parts_of_sample = ("noise", *(f"modifiers[{number}]" for number in range(len(self._modifiers))))
        self._part_forms = {name: dataclasses.replace(term.form, width=width) for name in parts_of_sample}
        self.shape = self.sample_shape
        if history_length:
            self.shape = (self.width * history_length,) if flatten else (history_length, *self.sample_shape)

    def share(self, others: Iterable[ObservationTerm]) -> None:
        """Reuse the observations of a term in ``others`` with the same function and equal parameters, but no state."""
        term = self.term
        if term.stateful is not None or term.generator is not None:
            return
        for other in others:
            if other.same_as is None and term.func is other.term.func and _same(term.params, other.term.params):
                self.same_as = other
                self._when_shared = [(params, dict(params)) for params in (term.params, other.term.params)]
                self._same_sample = self._processes_as() == other._processes_as()
                return

    def _processes_as(self) -> object:
        """Return equal objects for two terms only if both terms clip and scale their values in the same way."""
        plain = not self._modifiers and self._noise is None and self.delay is None
        return (self._clip, self._scale) if plain and not isinstance(self._scale, torch.Tensor) else object()

    def sample(self, values: Values) -> torch.Tensor:
        """Draw noise, advance delay and modifiers, and return the sample (N, ...); store it in ``values``."""
        owner = self
        # Since ``share`` was called, a curriculum may have changed a parameter of one of the two terms.
        is_same = all(now.keys() == then.keys() for now, then in self._when_shared)
        is_same = is_same and all(now[name] is v for now, then in self._when_shared for name, v in then.items())
        if self.same_as is not None and is_same:
            owner = self.same_as
            if self._same_sample and owner in values.samples:
                return values.samples[owner]
        if owner not in values.raw:
            values.raw[owner] = owner.term(self._env)
        value = values.raw[owner]
        if self.delay is not None:
            value = self.delay.push(value)
        sample = self._processed(value, draw=True)
        if owner is self or self._same_sample:
            values.samples[owner] = sample
        return sample

    def sample_between(self) -> None:
        """Sample an observation term that has a delay; called between two physics steps of a control step."""
        assert self.delay is not None
        self.delay.push(self.term(self._env))

    def peek(self) -> torch.Tensor:
        """Return the sample of the observation term without noise; do not change any state."""
        owners = [*self._modifiers, *([self.term.stateful] if self.term.stateful is not None else [])]
        states = [owner.state_dict() for owner in owners]
        stream = None if self.term.generator is None else self.term.generator.get_state()
        value = self.term(self._env)
        value = self._processed(value if self.delay is None else self.delay.peek(value), draw=False).clone()
        for owner, state in zip(owners, states, strict=True):
            owner.load_state_dict(state)
        if self.term.generator is not None and stream is not None:
            self.term.generator.set_state(stream)
        return value

    def shown(self, history: torch.Tensor) -> torch.Tensor:
        """Flatten a history (N, H, ...) to (N, columns) if the setting ``flatten_history_dim`` is true."""
        return history.flatten(1) if self._flatten else history

    def parts(self) -> dict[str, object]:
        """Return the modifier and noise objects of the term by config key."""
        found = {f"modifiers[{number}]": modifier for number, modifier in enumerate(self._modifiers)}
        return found | ({} if self._noise is None else {"noise": self._noise})

    def reset(self, env_ids: torch.Tensor) -> None:
        """Reset the term's object, modifiers, noise, and delay in the environments ``env_ids``."""
        if self.term.stateful is not None:
            self.term.stateful.reset(env_ids)
        for modifier in self._modifiers:
            modifier.reset(env_ids)
        if hasattr(self._noise, "reset"):
            self._noise.reset(env_ids, self._generator)
        if self.delay is not None:
            self.delay.reset(env_ids)

    def _processed(self, value: torch.Tensor, *, draw: bool) -> torch.Tensor:
        if self._modifiers or self._noise is not None:
            value = value.clone()  # Copy the observation, because a user-defined modifier may change it in place.
        for number, modifier in enumerate(self._modifiers):
            value = self._part(f"modifiers[{number}]", modifier, value)
        if draw and self._noise is not None:
            exact = value[: self._env.exact_envs].clone()  # A user-defined noise may change ``value`` in place.
            value = self._part("noise", self._noise, value, self._generator)
            value = torch.cat((exact, value[len(exact) :])) if len(exact) else value
        if self._clip is not None:
            value = value.clip(self._clip[0], self._clip[1])
        return value if self._scale is None else value * self._scale

    def _part(self, name: str, part: Callable[..., torch.Tensor], *args: object) -> torch.Tensor:
        path, form = f"{self.term.path}.{name}", self._part_forms[name]
        with blamed(path, part, has_worked=form.is_known, what="a term"):
            value = part(*args)
        require_form(form, value, f"'{dotted_name(part)}'", path, part)
        return value


def _same(mine: Mapping[str, object], theirs: Mapping[str, object]) -> bool:
    """Return whether two terms have equal parameters. Lists and other mutable values always count as different."""
    for name, value in mine.items():
        other = theirs.get(name)
        if isinstance(value, SceneEntityCfg) and isinstance(other, SceneEntityCfg):
            names = ("name", "joint_names", "body_names", "preserve_order")
            is_equal = all(getattr(value, name) == getattr(other, name) for name in names)
        else:
            is_plain = type(value) is type(other) and isinstance(value, (str, bool, int, float, type(None)))
            is_equal = is_plain and value == other
        if not is_equal:
            return False
    return mine.keys() == theirs.keys()


Group = torch.Tensor | dict[str, torch.Tensor]


class GroupLayout:
    """Joins the observations of a group's terms, and splits the joined observation."""

    def __init__(self, terms: Mapping[str, ObservationTerm], options: GroupOptions, path: str) -> None:
        shapes = {name: term.shape for name, term in terms.items()}
        self.concatenated = options.concatenate_terms  # whether the group is one tensor
        self.by_time = options.history_order == "time"  # whether histories are ordered by step and then by term
        self._dim = options.concatenate_dim
        if self.by_time:
            plain = all(len(term.shape) == len(term.sample_shape) == 1 for term in terms.values())
            lengths = {term.history_length for term in terms.values()}
            if not (plain and len(lengths) == 1 and lengths != {0} and options.concatenate_terms):
                message, key = "the histories of the terms cannot be ordered by step", f"{path}.history_order"
                expected = "concatenate_terms and flatten_history_dim true, "
                expected += "and one history_length of at least 1 for vectors"
                raise ConfigError(message, key=key, expected=expected)
        if not self.concatenated:
            # One shape for each term, or one shape for the joined observation.
            self.shape: tuple[int, ...] | list[tuple[int, ...]] = list(shapes.values())
            return
        _require_joinable(shapes, self._dim, path)
        widths = {name: shape[self._dim] for name, shape in shapes.items()}
        first = list(next(iter(shapes.values())))
        first[self._dim] = sum(widths.values())
        self.shape = tuple(first)
        steps = next(iter(terms.values())).history_length if self.by_time else 1
        # Slices of each term along the joined dimension: one, or with ``by_time`` one for each step.
        self.parts: dict[str, list[slice]] = {name: [] for name in widths}
        start = 0
        for _ in range(steps):
            for name, width in widths.items():
                self.parts[name].append(slice(start, start + width // steps))
                start += width // steps
        self._dim += self._dim >= 0  # In ``concatenate_dim``, 0 is the first dimension after the environments.

    def shown(self, term: ObservationTerm, history: torch.Tensor) -> torch.Tensor:
        """Flatten a term's history (N, H, ...), unless ``join`` will interleave the histories of all terms by step."""
        return history if self.by_time else term.shown(history)

    def join(self, values: dict[str, torch.Tensor]) -> Group:
        """Join the observations of a group's terms to the observation of the group."""
        if not self.concatenated:
            return values
        if self.by_time:
            return torch.cat(list(values.values()), dim=-1).flatten(1)
        return torch.cat(list(values.values()), dim=self._dim)

    def part(self, name: str, value: Group) -> torch.Tensor:
        """Extract the observation (n, ...) of one term from that of the group. Histories are ordered oldest first."""
        if not isinstance(value, torch.Tensor):
            return value[name]
        found = [value.narrow(self._dim, part.start, part.stop - part.start) for part in self.parts[name]]
        return found[0] if len(found) == 1 else torch.cat(found, dim=self._dim)


def _require_joinable(shapes: Mapping[str, tuple[int, ...]], dim: int, path: str) -> None:
    deepest = max(map(len, shapes.values()))
    if not -deepest <= dim < deepest:
        message = f"the terms have no dimension {dim}"
        raise ConfigError(message, key=f"{path}.concatenate_dim", expected=f"from {-deepest} to {deepest - 1}")
    others = {tuple(size for axis, size in enumerate(shape) if axis != dim % deepest) for shape in shapes.values()}
    if len({len(shape) for shape in shapes.values()}) > 1 or len(others) > 1:
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ConfigError(
            f"observation terms of different shapes cannot be concatenated: {listed}",
            key=f"{path}.terms",
            expected="one history_length and flatten_history_dim for all, value.flatten(1) in terms that return more "
            "than vectors, or concatenate_terms: false",
        )
