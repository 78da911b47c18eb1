"""Ring-free history of the last samples, oldest first."""

from __future__ import annotations

import torch


class HistoryBuffer:
    """The last H samples of each environment.

    The first sample after a reset fills every slot, as in Isaac Lab.

    Args:
        num_envs: number of environments, N.
        length: samples kept, H.
        shape: shape of one sample.
    """

    def __init__(self, num_envs: int, length: int, shape: torch.Size) -> None:
        self.samples = torch.zeros(num_envs, length, *shape)
        self.empty = torch.ones(num_envs, dtype=torch.bool)
        self._any_empty = True

    def append(self, sample: torch.Tensor) -> None:
        """Take up a sample (N, ...); the oldest is dropped."""
        self.samples[:, :-1] = self.samples[:, 1:].clone()
        self.samples[:, -1] = sample
        if self._any_empty:
            ids = self.empty.nonzero().squeeze(1)
            self.samples[ids] = sample[ids].unsqueeze(1).expand(-1, *self.samples.shape[1:])
            self.empty.fill_(False)
            self._any_empty = False

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the samples of ``env_ids``."""
        self.samples[env_ids] = 0.0
        self.empty[env_ids] = True
        self._any_empty = True

    def appended(self, sample: torch.Tensor) -> torch.Tensor:
        """Return what ``append`` would leave (N, H, ...), without storing it."""
        after = torch.cat((self.samples[:, 1:], sample.unsqueeze(1)), dim=1)
        if self._any_empty:
            ids = self.empty.nonzero().squeeze(1)
            after[ids] = sample[ids].unsqueeze(1).expand(-1, *after.shape[1:])
        return after

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return samples and which environments have none."""
        return {"samples": self.samples.clone(), "empty": self.empty.clone()}

    def load_state_dict(self, saved: dict[str, torch.Tensor]) -> None:
        """Restore what ``state_dict`` returned."""
        self.samples.copy_(saved["samples"])
        self.empty.copy_(saved["empty"])
        self._any_empty = bool(self.empty.any())
