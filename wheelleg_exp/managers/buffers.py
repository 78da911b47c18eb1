"""History of the last samples, oldest first."""

from __future__ import annotations

import torch


class HistoryBuffer:
    """The last H samples of each environment.

    The first sample of an episode fills every slot, as in Isaac Lab. ``append`` makes a new tensor instead of
    writing into the old one, so that what was handed out before never changes.

    Args:
        num_envs: number of environments, N.
        length: samples kept, H.
        shape: shape of one sample.
        device: where the samples are.
    """

    def __init__(self, num_envs: int, length: int, shape: torch.Size, device: torch.device) -> None:
        self.samples = torch.zeros(num_envs, length, *shape, device=device)

    def append(self, sample: torch.Tensor, first: torch.Tensor | None) -> torch.Tensor:
        """Take up a sample (N, ...), drop the oldest, and return the history (N, H, ...).

        Args:
            sample: the new sample.
            first: environments for which it is the first of an episode, or None.
        """
        self.samples = self.appended(sample, first)
        return self.samples

    def appended(self, sample: torch.Tensor, first: torch.Tensor | None) -> torch.Tensor:
        """Return what ``append`` would, without storing it."""
        newest = sample.unsqueeze(1)
        after = torch.cat((self.samples[:, 1:], newest), dim=1)
        if first is not None:
            after[first] = newest[first]
        return after

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the samples."""
        return {"samples": self.samples.clone()}

    def load_state_dict(self, saved: dict[str, torch.Tensor]) -> None:
        """Restore what ``state_dict`` returned."""
        self.samples = saved["samples"].clone()
