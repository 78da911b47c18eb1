"""Samples that arrive some physics steps late, by a lag of each environment's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from wheelleg_exp.sim.ids import fill_rows


class DelayBuffer:
    """The last samples of each environment, of which it hands out the one of age ``lag``.

    The first sample after a reset stands for all before it, so that the age is ``min(lag, samples - 1)``, as in Isaac
    Lab's ``DelayBuffer``. Lags are drawn at a reset, uniform in their range; before the first they are 0.

    Args:
        sample: a sample (N, ...).
        lags: shortest and longest lag, in samples.
        generator: what lags are drawn from.
    """

    def __init__(self, sample: torch.Tensor, lags: Sequence[int], generator: torch.Generator) -> None:
        self._range, self._generator = lags, generator
        self._samples = torch.zeros(len(sample), lags[1] + 1, *sample.shape[1:], device=sample.device)
        self._rows = torch.arange(len(sample), device=sample.device)
        self._is_first = torch.ones(len(sample), dtype=torch.bool, device=sample.device)
        self.lag = torch.zeros(len(sample), dtype=torch.long, device=sample.device)

    def push(self, sample: torch.Tensor) -> torch.Tensor:
        """Take up a sample (N, ...) and return the delayed one."""
        # A new tensor, as the old one may belong to inference mode.
        self._samples = self._pushed(sample)
        self._is_first.fill_(False)
        return self._read(self._samples)

    def peek(self, sample: torch.Tensor) -> torch.Tensor:
        """Return what ``push`` would, and change nothing."""
        return self._read(self._pushed(sample))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the samples of ``env_ids`` and draw their lags."""
        low, high = self._range
        drawn = torch.randint(low, high + 1, (len(env_ids),), generator=self._generator, device=self.lag.device)
        self.lag[env_ids] = drawn
        fill_rows(self._is_first, env_ids, True)

    def state_dict(self) -> dict[str, Any]:
        """Return samples and lags."""
        return {"samples": self._samples.clone(), "is_first": self._is_first.clone(), "lag": self.lag.clone()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self._samples = saved["samples"].clone()
        self._is_first.copy_(saved["is_first"])
        self.lag.copy_(saved["lag"])

    def _pushed(self, sample: torch.Tensor) -> torch.Tensor:
        """Return the samples with one more, newest first."""
        newest = sample.unsqueeze(1)
        later = torch.cat((newest, self._samples[:, :-1]), dim=1)
        first = self._is_first.view(-1, *[1] * (later.ndim - 1))
        return torch.where(first, newest, later)

    def _read(self, samples: torch.Tensor) -> torch.Tensor:
        return samples[self._rows, self.lag]
