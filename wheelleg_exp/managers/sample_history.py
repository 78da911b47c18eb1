"""Store the last samples of observation terms as histories, oldest sample first, and delay observations.

Each new sample creates a new tensor, so that returned histories never change. The first sample of an episode fills the
whole history, as in Isaac Lab. ``first`` marks these environments as indices or a mask (N,); None for no environment.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from wheelleg_exp.machine import require_memory
from wheelleg_exp.managers.manager_base import Term
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.delay import DelayBuffer
from wheelleg_exp.state import Stateful


class HistoryBuffer(Stateful):
    """A buffer of the last H samples of each environment, (N, H, ...)."""

    def __init__(self, num_envs: int, length: int, shape: Sequence[int], device: torch.device) -> None:
        self.samples = self.buffer("samples", torch.zeros(num_envs, length, *shape, device=device))

    def append(self, sample: torch.Tensor, first: torch.Tensor | None) -> torch.Tensor:
        """Append a sample (N, ...), drop the oldest sample, and return the history (N, H, ...)."""
        self.samples = self.appended(sample, first)
        return self.samples

    def appended(self, sample: torch.Tensor, first: torch.Tensor | None) -> torch.Tensor:
        """Return the history with ``sample`` as its newest sample, but do not store ``sample``."""
        newest = sample.unsqueeze(1)
        after = torch.cat((self.samples[:, 1:], newest), dim=1)
        if first is not None and first.dtype == torch.bool:
            return torch.where(first.view(-1, *[1] * (after.ndim - 1)), newest, after)
        if first is not None:
            after[first] = newest[first]
        return after

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        self.samples = saved["samples"].clone()  # Histories that were already returned must not change.


class RowHistory(Stateful):
    """Stores the histories of several observation terms in one row per environment: term by term, oldest sample first.

    ``widths`` are the sizes of the terms' samples. ``lengths`` are numbers of samples; 0 stores only the newest.
    """

    def __init__(self, num_envs: int, widths: Sequence[int], lengths: Sequence[int], device: torch.device) -> None:
        slots = [max(1, length) for length in lengths]
        sizes = [width * count for width, count in zip(widths, slots, strict=True)]
        ends = list(itertools.accumulate(sizes))
        self._spans = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        self._older = [slice(s.start + width, s.stop) for s, width in zip(self._spans, widths, strict=True)]
        self._widths = list(widths)
        firsts = zip(itertools.accumulate(widths), widths, slots, strict=True)
        columns = [torch.arange(end - width, end, device=device).repeat(count) for end, width, count in firsts]
        self._fill = torch.cat(columns)
        self.remembers = max(lengths) > 0
        self.values = self.buffer("values", torch.zeros(num_envs, sum(sizes), device=device), saved=False)

    def append(self, samples: Sequence[torch.Tensor], first: torch.Tensor | None) -> torch.Tensor:
        """Append one sample (N, width) of each term, and return the histories of all terms in one row (N, columns)."""
        self.values = self.appended(samples, first)
        return self.values.clone() if self.remembers else self.values

    def appended(self, samples: Sequence[torch.Tensor], first: torch.Tensor | None) -> torch.Tensor:
        """Return the histories that ``append`` would return for ``samples``, but store nothing."""
        pieces = []
        for older, sample in zip(self._older, samples, strict=False):
            if older.start < older.stop:
                pieces.append(self.values[:, older])
            pieces.append(sample)
        after = torch.cat(pieces, dim=1)
        if first is not None and self.remembers and first.dtype == torch.bool:
            newest = torch.cat(list(samples), dim=1).index_select(1, self._fill[: after.shape[1]])
            return torch.where(first.unsqueeze(1), newest, after)
        if first is not None and self.remembers:
            newest = torch.cat(list(samples), dim=1).index_select(0, first)
            after.index_copy_(0, first, newest.index_select(1, self._fill[: after.shape[1]]))
        return after

    def part(self, index: int) -> RowHistoryPart:
        """Return the history of the observation term with the index ``index``."""
        return RowHistoryPart(self, self._spans[index], self._widths[index])


class RowHistoryPart(Stateful):
    """The history of one observation term, which is stored as columns of a ``RowHistory``."""

    def __init__(self, row: RowHistory, span: slice, width: int) -> None:
        self._row, self._span, self._width = row, span, width

    @property
    def samples(self) -> torch.Tensor:
        """The last H samples of one observation term, oldest first, (N, H, width)."""
        found: torch.Tensor = self._row.values[:, self._span].unflatten(1, (-1, self._width))
        return found

    def state_dict(self) -> dict[str, object]:
        return {"samples": self.samples.contiguous().clone()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        self._row.values = self._row.values.clone()  # Histories that were already returned must not change.
        self._row.values[:, self._span] = saved["samples"].flatten(1)


def made_delay(term: Term, sample: torch.Tensor, env: Env, prompt: int) -> DelayBuffer | None:
    """Return the buffer that delays a term's samples (N, ...), except in the first ``prompt`` environments, or None."""
    low, high = term.fields.get("delay") or (0, 0)
    jitter = term.fields.get("delay_jitter") or 0
    if high + jitter == 0:
        return None
    key, count = f"{term.path}.delay", high + jitter + 1
    require_memory(4 * sample.numel() * count, key, f"{count} samples of {env.num_envs} environments")
    return DelayBuffer(sample, (low, high), env.streams.get(key), jitter, prompt)
