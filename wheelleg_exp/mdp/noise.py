"""Noise on observations: constant, uniform and Gaussian noise, and a bias that is drawn at each reset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch

from wheelleg_exp.constraints import Broken, NonNegative, relation

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


def _ordered(given: Mapping[str, Any]) -> Iterator[Broken]:
    if given["n_min"] > given["n_max"]:
        yield Broken("n_max", f"{given['n_max']!r} is below n_min", f"at least {given['n_min']!r}")


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


def _bias_does_not_add_up(given: Mapping[str, Any]) -> Iterator[Broken]:
    operation = given["bias_noise_cfg"].get("operation", "add")
    if operation != "abs":
        message = f"the bias noise has operation '{operation}'"
        yield Broken("bias_noise_cfg.operation", message, "abs, because the bias would accumulate over resets")


@relation(_bias_does_not_add_up)
class NoiseModelWithAdditiveBias:
    """Observation noise plus a bias that is drawn at each reset.

    Args:
        noise_cfg: the noise of every step.
        bias_noise_cfg: the distribution of the bias; its operation must be ``abs``, so that biases do not accumulate
            over resets.
        sample_bias_per_component: draw one bias for each component, else one for all components of an environment.
    """

    def __init__(self, noise_cfg: Noise, bias_noise_cfg: Noise, sample_bias_per_component: bool = True) -> None:
        self._noise, self._bias_noise = noise_cfg, bias_noise_cfg
        self._per_component = sample_bias_per_component
        self._bias: torch.Tensor | None = None

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

    def state_dict(self) -> dict[str, Any]:
        """Return the observation bias of each environment, which a checkpoint saves."""
        return {"bias": None if self._bias is None else self._bias.clone()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore the observation bias of each environment from a checkpoint."""
        self._bias = None if saved["bias"] is None else saved["bias"].clone()
