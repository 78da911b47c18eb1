"""How the terms of an observation group are joined, and where each of them lies in it."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.observation_term import ObservationTerm
from wheelleg_exp.terms.sections import ObservationGroup as GroupOptions

Group = torch.Tensor | dict[str, torch.Tensor]


class GroupLayout:
    """Joins the terms of a group, and takes them out of it again.

    Args:
        terms: the terms by name, in order.
        options: the group's settings.
        path: the group's config key.

    Raises:
        ConfigError: the terms cannot be joined as the settings say.

    Attributes:
        concatenated: whether the group is one tensor.
        by_time: whether flattened histories stand step by step, oldest first, each with all terms; else term by term.
        shape: shape of one environment's observation, of each term where they are not joined.
        parts: where each term lies along the joined dimension; a slice a step where histories stand step by step.
    """

    def __init__(self, terms: Mapping[str, ObservationTerm], options: GroupOptions, path: str) -> None:
        shapes = {name: term.shape for name, term in terms.items()}
        self.concatenated = options.concatenate_terms
        self.by_time = options.history_order == "time"
        self._dim = options.concatenate_dim
        if self.by_time:
            _require_steps(terms, options, path)
        if not self.concatenated:
            self.shape: tuple[int, ...] | list[tuple[int, ...]] = list(shapes.values())
            return
        _require_joinable(shapes, self._dim, path)
        widths = {name: shape[self._dim] for name, shape in shapes.items()}
        first = list(next(iter(shapes.values())))
        first[self._dim] = sum(widths.values())
        self.shape = tuple(first)
        steps = next(iter(terms.values())).history_length if self.by_time else 1
        self.parts = _parts({name: width // steps for name, width in widths.items()}, steps)
        self._dim += self._dim >= 0  # the environments come first

    def shown(self, term: ObservationTerm, history: torch.Tensor) -> torch.Tensor:
        """Return a history (N, H, ...) of one term as ``join`` takes it."""
        return history if self.by_time else term.shown(history)

    def join(self, values: dict[str, torch.Tensor]) -> Group:
        """Return the group's observation from those of its terms."""
        if not self.concatenated:
            return values
        if self.by_time:
            return torch.cat(list(values.values()), dim=-1).flatten(1)
        return torch.cat(list(values.values()), dim=self._dim)

    def part(self, name: str, value: Group) -> torch.Tensor:
        """Return one term's observation from the group's, (n, ...); histories oldest first."""
        if not isinstance(value, torch.Tensor):
            return value[name]
        found = [value.narrow(self._dim, part.start, part.stop - part.start) for part in self.parts[name]]
        return found[0] if len(found) == 1 else torch.cat(found, dim=self._dim)


def _parts(widths: Mapping[str, int], steps: int) -> dict[str, list[slice]]:
    """Return the slices of each term in ``steps`` rounds of all terms."""
    found: dict[str, list[slice]] = {name: [] for name in widths}
    start = 0
    for _ in range(steps):
        for name, width in widths.items():
            found[name].append(slice(start, start + width))
            start += width
    return found


def _require_steps(terms: Mapping[str, ObservationTerm], options: GroupOptions, path: str) -> None:
    plain = all(len(term.shape) == len(term.sample_shape) == 1 for term in terms.values())
    lengths = {term.history_length for term in terms.values()}
    if not (plain and len(lengths) == 1 and lengths != {0} and options.concatenate_terms):
        raise ConfigError(
            "the histories of the terms do not stand step by step",
            key=f"{path}.history_order",
            expected="concatenate_terms and flatten_history_dim true, and one history_length of at least 1 for vectors",
        )


def _require_joinable(shapes: Mapping[str, tuple[int, ...]], dim: int, path: str) -> None:
    deepest = max(map(len, shapes.values()))
    if not -deepest <= dim < deepest:
        raise ConfigError(
            f"the terms have no dimension {dim}",
            key=f"{path}.concatenate_dim",
            expected=f"from {-deepest} to {deepest - 1}",
        )
    others = {tuple(size for axis, size in enumerate(shape) if axis != dim % deepest) for shape in shapes.values()}
    if len({len(shape) for shape in shapes.values()}) > 1 or len(others) > 1:
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ConfigError(
            f"terms of different shape cannot stand in one observation: {listed}",
            key=f"{path}.terms",
            expected="one history_length and flatten_history_dim for all, value.flatten(1) in terms that return more "
            "than vectors, or concatenate_terms: false",
        )
