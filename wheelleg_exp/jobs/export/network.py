"""The network as plain arrays: normalisation, then linear layers with activations between; and in float64."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict

from wheelleg_exp.errors import ConfigError

_ACTIVATIONS: dict[type, str] = {
    torch.nn.ELU: "elu",
    torch.nn.CELU: "elu",  # with alpha 1, as rsl_rl makes it
    torch.nn.ReLU: "relu",
    torch.nn.LeakyReLU: "leaky_relu",
    torch.nn.SELU: "selu",
    torch.nn.Tanh: "tanh",
    torch.nn.Sigmoid: "sigmoid",
    torch.nn.Softplus: "softplus",
    torch.nn.SiLU: "swish",
    torch.nn.Identity: "identity",
}
ROLES = ("student", "actor")
_GAUSSIAN = GaussianDistribution.__name__


def require_perceptron(section: Mapping[str, Any], key: str) -> None:
    """Raise ConfigError, by name, for a network that is no perceptron whose output is the mean action.

    Args:
        section: the network's section of the agent.
        key: its config key.
    """
    if section["class_name"] != MLPModel.__name__:
        raise ConfigError(
            f"a runner does not know networks of class '{section['class_name']}'",
            key=f"{key}.class_name",
            expected="MLPModel: no memory of its own, no pictures",
        )
    distribution = (section.get("distribution_cfg") or {}).get("class_name", _GAUSSIAN)
    if distribution != _GAUSSIAN:
        raise ConfigError(
            f"a runner does not know the mean of a '{distribution}'",
            key=f"{key}.distribution_cfg.class_name",
            expected=f"{_GAUSSIAN}, whose mean is the network's output",
        )


def network_arrays(policy: MLPModel, role: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what a network is, for people and runners, and its arrays by name, float32 but for the deviation.

    Args:
        policy: the trained network, a perceptron.
        role: its section of the agent, ``actor`` or ``student``.

    Raises:
        ConfigError: a runner does not know an activation.
    """
    key = f"agent.{role}"
    arrays: dict[str, np.ndarray] = {}
    if policy.obs_normalization:
        normalizer = policy.obs_normalizer
        arrays["mean"] = _array(normalizer._mean[0])
        arrays["deviation"] = (normalizer._std[0].double() + normalizer.eps).numpy()
    activations: list[str] = []
    for layer in policy.mlp:
        if isinstance(layer, torch.nn.Linear):
            arrays[f"weight_{len(activations)}"] = _array(layer.weight)
            arrays[f"bias_{len(activations)}"] = _array(layer.bias)
            activations.append("identity")
        else:
            activations[-1] = _activation(layer, key)
    widths = [arrays[f"bias_{k}"].size for k in range(len(activations))]
    about = {"file": "policy.npz", "dtype": "float32", "widths": widths, "activations": activations}
    return about | {"normalized": bool(policy.obs_normalization)}, arrays


def in_float64(policy: MLPModel) -> Callable[[TensorDict], torch.Tensor]:
    """Return the mean action (N, A) of a network as a function that computes in float64, and rounds at the end.

    It has no order of sums that matters; in float32 two libraries differ by some 1e-6.
    """
    precise = copy.deepcopy(policy).double()

    def act(observations: TensorDict) -> torch.Tensor:
        return precise(observations.double()).float()

    return act


def _activation(layer: torch.nn.Module, key: str) -> str:
    name = _ACTIVATIONS.get(type(layer))
    if name is None:
        raise ConfigError(
            f"a runner does not know the activation '{type(layer).__name__}'",
            key=f"{key}.activation",
            expected="one of elu, relu, lrelu, selu, tanh, sigmoid, softplus, swish, identity",
        )
    return name


def _array(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().numpy().astype(np.float32)
