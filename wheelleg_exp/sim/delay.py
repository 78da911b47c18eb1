"""Delay samples and joint targets by a number of physics steps that can differ between environments."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.sim.robot_model import JointTargets
from wheelleg_exp.state import Stateful


class DelayBuffer(Stateful):
    """A buffer of the last samples of each environment; ``push`` returns the sample stored ``lag`` calls earlier.

    As in Isaac Lab, the first sample after a reset is returned until ``lag`` later samples have been stored. Each reset
    draws the lag uniformly from ``lags``; before the first reset, it is 0. With ``jitter``, each ``push`` adds 0 to
    ``jitter`` calls at random, but never returns an older sample than the ``push`` before. All samples have the shape
    and device of ``sample``, for example (N, 3). The first ``prompt`` environments have no delay.

    Attributes:
        lag: the lag of each environment, in calls of ``push``, (N,).
        share: share of ``lags`` and ``jitter`` that each environment uses, (N,). CUDA graphs read it: write in place.
    """

    def __init__(
        self, sample: torch.Tensor, lags: Sequence[int], generator: torch.Generator, jitter: int = 0, prompt: int = 0
    ) -> None:
        self._range, self._generator, self._jitter = lags, generator, jitter
        self.share = self.buffer("share", torch.ones(len(sample), device=sample.device))
        shape = (len(sample), lags[1] + jitter + 1, *sample.shape[1:])
        self._samples = self.buffer("_samples", torch.zeros(shape, device=sample.device))
        self._rows = torch.arange(len(sample), device=sample.device)
        self._is_late = (self._rows >= prompt).long()
        self._is_first = self.buffer("_is_first", torch.ones(len(sample), dtype=torch.bool, device=sample.device))
        self.lag = self.buffer("lag", torch.zeros(len(sample), dtype=torch.long, device=sample.device))
        # ``_last_lag`` is the lag of the sample that ``push`` last returned.
        self._last_lag = self.buffer("_last_lag", torch.zeros_like(self.lag))

    def push(self, sample: torch.Tensor) -> torch.Tensor:
        """Store a sample (N, ...), and return the sample that was stored ``lag`` calls earlier."""
        # Do not change ``_samples`` in place, because torch forbids this for tensors created in inference mode.
        self._samples = self._pushed(sample)
        self._is_first.fill_(False)
        lag = self.lag
        if self._jitter:
            extra = torch.randint(0, self._jitter + 1, lag.shape, generator=self._generator, device=lag.device)
            lag = torch.minimum(lag + self._is_late * (self.share * extra).round().long(), self._last_lag + 1)
        self._last_lag.copy_(lag)
        return self._read(self._samples)

    def peek(self, sample: torch.Tensor) -> torch.Tensor:
        """Return the delayed sample that ``push`` would return, but do not store ``sample``."""
        return self._read(self._pushed(sample))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Drop the stored samples of the environments ``env_ids``, and draw new lags for them."""
        low, high, size = *self._range, (len(env_ids),)
        drawn = torch.randint(0, high - low + 1, size, generator=self._generator, device=self.lag.device)
        self.lag[env_ids] = self._is_late[env_ids] * (low + (self.share[env_ids] * drawn).round().long())
        self._last_lag[env_ids] = self.lag[env_ids]
        fill_rows(self._is_first, env_ids, True)

    def _pushed(self, sample: torch.Tensor) -> torch.Tensor:
        newest = sample.unsqueeze(1)
        later = torch.cat((newest, self._samples[:, :-1]), dim=1)
        return torch.where(self._is_first.view(-1, *[1] * (later.ndim - 1)), newest, later)

    def _read(self, samples: torch.Tensor) -> torch.Tensor:
        return samples[self._rows, self._last_lag]


class TargetDelay(Stateful):
    """Delays joint targets of the shape (N, J) by one lag per environment, drawn from ``bounds``, physics steps."""

    def __init__(
        self, bounds: Sequence[int], joint_ids: torch.Tensor, shape: tuple[int, int], generator: torch.Generator
    ) -> None:
        device = joint_ids.device
        self._ids = joint_ids
        sample = torch.zeros(shape[0], 3, len(joint_ids), device=device)
        self._past = self.child("_past", DelayBuffer(sample, bounds, generator))
        self._seen = self.buffer("_seen", torch.zeros(shape[0], 3, shape[1], device=device))
        self.targets = JointTargets(*self._seen.unbind(dim=1))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Drop the stored joint targets of the environments ``env_ids``, and draw new lags for them."""
        self._past.reset(env_ids)

    def push(self, targets: JointTargets) -> JointTargets:
        """Store joint targets; return the delayed targets of the joints ``joint_ids``, and 0 for all other joints."""
        ids = self._ids
        now = torch.stack((targets.pos[:, ids], targets.vel[:, ids], targets.effort[:, ids]), dim=1)
        self._seen[:, :, ids] = self._past.push(now)
        return self.targets
