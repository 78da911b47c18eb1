"""Noise on observations: constant, uniform and Gaussian noise, a bias drawn at each reset, and a sensor's errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import torch

from wheelleg_exp.constraints import Broken, NonNegative, Share, relation
from wheelleg_exp.state import Stateful

Operation = Literal["add", "scale", "abs"]


def _apply(value: torch.Tensor, drawn: torch.Tensor | float, operation: Operation) -> torch.Tensor:
    if operation == "add":
        return value + drawn
    return value * drawn if operation == "scale" else torch.zeros_like(value) + drawn


@dataclass
class ConstantNoise:
    """Constant observation noise: every value is shifted by ``bias``."""

    bias: float = 0.0
    operation: Operation = "add"

    def __call__(self, value: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        del generator
        return _apply(value, self.bias, self.operation)


def _ordered(n_min: float, n_max: float) -> Iterator[Broken]:
    if n_min > n_max:
        yield Broken("n_max", f"{n_max!r} is below n_min", f"at least {n_min!r}")


@relation(_ordered)
@dataclass
class UniformNoise:
    """Uniform observation noise U(n_min, n_max), drawn separately for each component."""

    n_min: float = -1.0
    n_max: float = 1.0
    operation: Operation = "add"

    def __call__(self, value: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        u = torch.rand(value.shape, generator=generator, device=value.device)
        return _apply(value, self.n_min + (self.n_max - self.n_min) * u, self.operation)


@dataclass
class GaussianNoise:
    """Gaussian observation noise N(mean, std^2), drawn separately for each component."""

    mean: float = 0.0
    std: NonNegative = 1.0
    operation: Operation = "add"

    def __call__(self, value: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        drawn = self.mean + self.std * torch.randn(value.shape, generator=generator, device=value.device)
        return _apply(value, drawn, self.operation)


Noise = ConstantNoise | UniformNoise | GaussianNoise


def _bias_does_not_add_up(bias_noise_cfg: Mapping[str, object]) -> Iterator[Broken]:
    operation = bias_noise_cfg.get("operation", "add")
    if operation != "abs":
        message = f"the bias noise has operation '{operation}'"
        yield Broken("bias_noise_cfg.operation", message, "abs, because the bias would accumulate over resets")


@relation(_bias_does_not_add_up)
class NoiseModelWithAdditiveBias(Stateful):
    """Observation noise plus a bias that is drawn at each reset.

    Args:
        noise_cfg: the noise of every step.
        bias_noise_cfg: distribution of the bias; its operation must be ``abs``, so that biases do not accumulate.
        sample_bias_per_component: draw one bias for each component, else one for all components of an environment.
    """

    def __init__(self, noise_cfg: Noise, bias_noise_cfg: Noise, sample_bias_per_component: bool = True) -> None:
        self._noise, self._bias_noise = noise_cfg, bias_noise_cfg
        self._per_component = sample_bias_per_component
        self._bias: torch.Tensor | None = self.buffer("_bias", None)
        self.child("noise_cfg", noise_cfg)
        self.child("bias_noise_cfg", bias_noise_cfg)

    def __call__(self, value: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        if self._bias is None:
            shape = value.shape if self._per_component else (len(value), *[1] * (value.ndim - 1))
            self._bias = self._bias_noise(value.new_zeros(shape), generator)
        return self._noise(value, generator) + self._bias

    def reset(self, env_ids: torch.Tensor, generator: torch.Generator) -> None:
        """Draw a new observation bias for the environments ``env_ids``."""
        # Replace ``_bias``, because tensors made in inference mode cannot be changed in place.
        if self._bias is not None:
            self._bias = self._bias.index_copy(0, env_ids, self._bias_noise(self._bias[env_ids], generator))


@dataclass(eq=False)
class SensorErrors(Stateful):
    """The errors of a real sensor, in this order: lag, drift, noise, resolution, lost readings. Not in Isaac Lab.

    Args:
        std: standard deviation of Gaussian noise, drawn for each component in each control step.
        drift: standard deviation of each step of a random walk of the reading, which starts at 0 in each episode.
        lag: largest time constant of a low-pass filter, control steps. Each episode draws T uniformly from [0,
            ``lag``]; in each step, the reading y approaches the true value x: y += (x - y) / (1 + T).
        resolution: distance between two possible readings; 0 means unlimited.
        lost: probability that a reading is lost in a control step; the last reading is then repeated.
    """

    std: NonNegative = 0.0
    drift: NonNegative = 0.0
    lag: NonNegative = 0.0
    resolution: NonNegative = 0.0
    lost: Share = 0.0

    def __post_init__(self) -> None:
        self._smooth: torch.Tensor | None
        for name in ("_smooth", "_walk", "_last", "_is_first", "_time_constant"):
            self.buffer(name, None)

    def __call__(self, value: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        if self._smooth is None:
            self._smooth, self._walk, self._last = value.clone(), torch.zeros_like(value), value.clone()
            self._is_first = torch.ones(len(value), *[1] * (value.ndim - 1), dtype=torch.bool, device=value.device)
            self._time_constant = self.lag * torch.rand(self._is_first.shape, generator=generator, device=value.device)
        smooth = self._smooth + (value - self._smooth) / (1.0 + self._time_constant)
        self._smooth = torch.where(self._is_first, value, smooth)
        normal = torch.randn((2, *value.shape), generator=generator, device=value.device)
        self._walk = self._walk + self.drift * normal[0]
        reading = self._smooth + self._walk + self.std * normal[1]
        if self.resolution:
            reading = (reading / self.resolution).round() * self.resolution
        u = torch.rand(self._is_first.shape, generator=generator, device=value.device)
        self._last = torch.where((u < self.lost) & ~self._is_first, self._last, reading)
        self._is_first = torch.zeros_like(self._is_first)
        return self._last

    def reset(self, env_ids: torch.Tensor, generator: torch.Generator) -> None:
        """Start episodes in the environments ``env_ids``: reset the walk and the filter, and draw the filter's lag."""
        if self._smooth is None:
            return
        rows = (len(env_ids), *self._is_first.shape[1:])
        drawn = self.lag * torch.rand(rows, generator=generator, device=env_ids.device)
        self._time_constant = self._time_constant.index_copy(0, env_ids, drawn)
        self._is_first = self._is_first.index_fill(0, env_ids, True)
        self._walk = self._walk.index_fill(0, env_ids, 0.0)
