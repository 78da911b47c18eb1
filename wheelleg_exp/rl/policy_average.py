"""Average a policy's weights over its last training iterations, for playing but not for training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.state import cloned

STATE = "averaged_state_dict"  # key in a checkpoint
_COUNT = "averaged_iterations"  # key in `unsaved`


class PolicyAverage:
    """The exponential mean of a policy's weights over training iterations.

    During training, the weights fluctuate around an optimum, and their mean is closer to it (Polyak and Juditsky,
    "Acceleration of stochastic approximation by averaging", SIAM Journal on Control and Optimization 30, 1992).
    Training continues with the current weights. In the first n = ``iterations`` iterations, the average m is the mean
    of all weights w so far. Later, each iteration moves m by (w - m) / n. ``iterations`` = 0 disables the average.
    """

    def __init__(self, policy: torch.nn.Module, iterations: int) -> None:
        self._policy, self._iterations = policy, iterations
        self.is_on = iterations > 0
        self._count = 0
        self._mean: dict[str, torch.Tensor] = {}

    @torch.no_grad()
    def take(self) -> None:
        """Add the policy's current weights to the mean weights, after each policy update."""
        if not self.is_on:
            return
        now = self._policy.state_dict()
        self._mean = self._mean or cloned(now)
        self._count += 1
        share = 1.0 / min(self._count, self._iterations)
        for name, value in now.items():
            self._mean[name].lerp_(value, share) if value.is_floating_point() else self._mean[name].copy_(value)

    def state_dict(self) -> dict[str, object]:
        """Return the policy's mean weights for a checkpoint; an empty dictionary before the first policy update."""
        return {STATE: cloned(self._mean)} if self._count else {}

    def unsaved(self) -> dict[str, int]:
        """Return the number of iterations in the average of a policy's weights."""
        return {_COUNT: self._count} if self._count else {}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Load mean weights, if any; raise ValueError if they do not fit the policy network."""
        if not self.is_on:
            return
        mean, own = saved.get(STATE) or {}, self._policy.state_dict()
        count = saved["unsaved"].get(_COUNT, 0)
        if mean and (type(count) is not int or count < 1 or _forms(mean) != _forms(own)):
            raise ValueError("the averaged weights in the checkpoint do not fit the policy network")
        self._count = count if mean else 0
        self._mean = {name: value.to(own[name].device, copy=True) for name, value in mean.items()}


def without_average(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state of a checkpoint without the averaged weights."""
    unsaved = {key: value for key, value in saved["unsaved"].items() if key != _COUNT}
    return {**{key: value for key, value in saved.items() if key != STATE}, "unsaved": unsaved}


def _forms(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in state.items()}
