"""Modifiers that transform an observation before noise is added to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch

from wheelleg_exp.constraints import Bounds, NotEmpty, Positive
from wheelleg_exp.state import Stateful


class Modifier(Stateful):
    """A function of an observation, which can declare buffers for past values."""

    def start(self, sample: torch.Tensor) -> None:
        """Allocate tensors for past samples of the observation; ``sample`` (N, ...) is an example."""

    def __call__(self, value: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError

    def reset(self, env_ids: torch.Tensor) -> None:
        """Clear the memory of ``env_ids``: fill the buffers that have a ``fill``."""
        self.reset_rows(env_ids)


@dataclass(eq=False)
class Scale(Modifier):
    """Multiply an observation by ``multiplier``."""

    multiplier: float

    def __call__(self, value: torch.Tensor) -> torch.Tensor:
        return value * self.multiplier


@dataclass(eq=False)
class Bias(Modifier):
    """Add ``value`` to an observation."""

    value: float

    def __call__(self, value: torch.Tensor) -> torch.Tensor:
        return value + self.value


@dataclass(eq=False)
class Clip(Modifier):
    """Clip an observation to ``bounds``."""

    bounds: Bounds

    def __call__(self, value: torch.Tensor) -> torch.Tensor:
        return value.clip(*map(float, self.bounds))


# Isaac Lab's names of the modifiers ``Scale``, ``Bias``, and ``Clip`` are in lower case.
scale, bias, clip = Scale, Bias, Clip


class DigitalFilter(Modifier):
    """Apply a digital filter: y_i = sum_{j>=0} B_j x_{i-j} - sum_{k>=1} A_k y_{i-k}.

    Args:
        A: feedback coefficients A_1, A_2, ...
        B: feed-forward coefficients B_0, B_1, ...
    """

    def __init__(self, A: Sequence[float], B: Annotated[Sequence[float], NotEmpty()]) -> None:
        self._given = (list(A), list(B))

    def start(self, sample: torch.Tensor) -> None:
        device = sample.device
        feedback, forward = (torch.tensor(given, dtype=torch.float32, device=device) for given in self._given)
        self._coefficients = (feedback, forward)
        inputs = torch.zeros(*sample.shape, len(forward), device=device)
        self._inputs = self.buffer("_inputs", inputs, fill=0.0)
        outputs = torch.zeros(*sample.shape, len(feedback), device=device)
        self._outputs = self.buffer("_outputs", outputs, fill=0.0)

    def __call__(self, value: torch.Tensor) -> torch.Tensor:
        self._inputs[..., 1:] = self._inputs[..., :-1].clone()
        self._inputs[..., 0] = value
        feedback, forward = self._coefficients
        filtered = self._inputs @ forward - self._outputs @ feedback
        if self._outputs.shape[-1]:
            self._outputs[..., 1:] = self._outputs[..., :-1].clone()
            self._outputs[..., 0] = filtered
        return filtered


@dataclass(eq=False)
class Integrator(Modifier):
    """Integrate an observation x: in each control step, the integral grows by (x + x_previous) / 2 * dt.

    Args:
        dt: time between two observations, s.
    """

    dt: Positive

    def start(self, sample: torch.Tensor) -> None:
        self._integral = self.buffer("_integral", torch.zeros_like(sample), fill=0.0)
        self._previous = self.buffer("_previous", torch.zeros_like(sample), fill=0.0)

    def __call__(self, value: torch.Tensor) -> torch.Tensor:
        self._integral += (value + self._previous) / 2 * self.dt
        self._previous.copy_(value)
        return self._integral.clone()
