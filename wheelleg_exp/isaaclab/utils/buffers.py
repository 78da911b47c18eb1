"""Buffers of the last samples of each environment, with the interface of ``isaaclab.utils.buffers``."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from wheelleg_exp.state import Stateful

Ids = Sequence[int] | torch.Tensor | None


class CircularBuffer(Stateful):
    """The last ``max_len`` samples of N environments; the first sample after a reset also fills all older places."""

    def __init__(self, max_len: int, batch_size: int, device: torch.device | str) -> None:
        if max_len < 1:
            raise ValueError(f"max_len is {max_len}, expected at least 1")
        self.max_length, self.batch_size, self.device = max_len, batch_size, device
        self._count = torch.zeros(batch_size, dtype=torch.long, device=device)
        Stateful.buffer(self, "_count", self._count)
        self._samples: torch.Tensor | None = Stateful.buffer(self, "_samples", None)

    @property
    def current_length(self) -> torch.Tensor:
        """Number of samples since the last reset, at most ``max_length``, (N,)."""
        return self._count.clamp(max=self.max_length)

    @property
    def buffer(self) -> torch.Tensor:  # type: ignore[override]  # Isaac Lab's name
        """The samples, oldest first, (N, max_length, ...)."""
        if self._samples is None:
            raise RuntimeError("the buffer is empty: call append first")
        return self._samples.clone()

    def reset(self, batch_ids: Ids = None) -> None:
        """Set the samples of the given environments to 0; None: of all environments."""
        rows = slice(None) if batch_ids is None else batch_ids
        self._count[rows] = 0
        if self._samples is not None:
            self._samples = self._samples.clone()  # A tensor from torch's inference mode cannot be changed in place.
            self._samples[rows] = 0

    def append(self, data: torch.Tensor) -> None:
        """Store a sample (N, ...) of each environment."""
        if len(data) != self.batch_size:
            raise ValueError(f"the sample has {len(data)} rows, expected {self.batch_size}")
        newest = data.to(self.device).unsqueeze(1)
        filled = newest.repeat_interleave(self.max_length, dim=1)
        if self._samples is not None:
            is_first = (self._count == 0).view(-1, *[1] * data.dim())
            filled = torch.where(is_first, filled, torch.cat((self._samples[:, 1:], newest), dim=1))
        self._samples = filled
        self._count += 1

    def __getitem__(self, key: torch.Tensor) -> torch.Tensor:
        """Return the sample that was stored ``key`` calls before the last one, or the oldest, (N, ...)."""
        if len(key) != self.batch_size:
            raise ValueError(f"the key has {len(key)} rows, expected {self.batch_size}")
        if self._samples is None or bool((self._count == 0).any()):
            raise RuntimeError("some environments have no sample: call append first")
        return self.latest(key)

    def latest(self, key: torch.Tensor) -> torch.Tensor:
        """Return the same as ``self[key]``, but without a check, which would wait for the GPU."""
        assert self._samples is not None
        places = self.max_length - 1 - torch.minimum(key, self.current_length - 1)
        return self._samples[torch.arange(self.batch_size, device=self.device), places]


class DelayBuffer(Stateful):
    """Delays the samples of each environment by 0 (at first) to ``history_length`` calls of ``compute``."""

    def __init__(self, history_length: int, batch_size: int, device: torch.device | str) -> None:
        self.history_length, self.batch_size, self.device = max(0, history_length), batch_size, device
        self._buffer = self.child("_buffer", CircularBuffer(self.history_length + 1, batch_size, device))
        self.time_lags = self.buffer("time_lags", torch.zeros(batch_size, dtype=torch.int, device=device))

    @property
    def min_time_lag(self) -> int:
        """Shortest delay of all environments."""
        return int(self.time_lags.min())

    @property
    def max_time_lag(self) -> int:
        """Longest delay of all environments."""
        return int(self.time_lags.max())

    def set_time_lag(self, time_lag: int | torch.Tensor, batch_ids: Ids = None) -> None:
        """Set the delay of the given environments; None: of all environments."""
        lags = torch.as_tensor(time_lag, device=self.device)
        if lags.dtype not in (torch.int, torch.long):
            raise TypeError(f"the delay has the type {lags.dtype}, expected int or long")
        if bool((lags < 0).any()) or bool((lags > self.history_length).any()):
            raise ValueError(f"the delay is {time_lag}, expected 0 to {self.history_length}")
        self.time_lags[slice(None) if batch_ids is None else batch_ids] = lags.int()

    def reset(self, batch_ids: Ids = None) -> None:
        """Drop the samples of the given environments; None: of all environments."""
        self._buffer.reset(batch_ids)

    def compute(self, data: torch.Tensor) -> torch.Tensor:
        """Store a sample (N, ...), and return the delayed sample of each environment."""
        self._buffer.append(data)
        return self._buffer.latest(self.time_lags)
