"""What event terms draw with: distributions, operations, and which environments."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import torch

from wheelleg_exp.constraints import Broken, Interval, Length
from wheelleg_exp.managers import Env

Operation = Literal["add", "scale", "abs"]
Distribution = Literal["uniform", "log_uniform", "gaussian"]
Pose = Literal["x", "y", "z", "roll", "pitch", "yaw"]
PoseRange = Mapping[Pose, Interval]
POSE = get_args(Pose)
Pair = Annotated[Sequence[float], Length(2)]  # [low, high], or of a Gaussian [mean, standard deviation]
Number = float | torch.Tensor


def draw(
    low: Number, high: Number, shape: Sequence[int], distribution: Distribution, generator: torch.Generator
) -> torch.Tensor:
    """Return draws of ``shape``: uniform or log-uniform on [low, high], or Gaussian with mean low and std high."""
    if distribution == "gaussian":
        return low + high * torch.randn(shape, generator=generator, device=generator.device)
    u = torch.rand(shape, generator=generator, device=generator.device)
    if distribution == "log_uniform":
        return low * (high / low) ** u
    return low + (high - low) * u


def operate(default: torch.Tensor, drawn: torch.Tensor, operation: Operation) -> torch.Tensor:
    """Return default + drawn (add), default * drawn (scale) or drawn (abs)."""
    if operation == "add":
        return default + drawn
    return default * drawn if operation == "scale" else drawn


def all_ids(env: Env, env_ids: torch.Tensor | None) -> torch.Tensor:
    """Return ``env_ids``, or all environments for None."""
    return torch.arange(env.num_envs, device=env.device) if env_ids is None else env_ids


def pair_error(pair: Sequence[float], operation: str, distribution: str, least: str = "") -> str | None:
    """Return what was expected of a pair that does not fit what it is drawn by, as Isaac Lab validates it.

    Args:
        pair: [low, high], or of a Gaussian [mean, standard deviation].
        operation: ``add``, ``scale`` or ``abs``.
        distribution: the distribution.
        least: what a scale's lower end must be: ``above 0``, ``at least 0``, or anything.
    """
    first, second = pair
    gaussian = distribution == "gaussian"
    least = "above 0" if distribution == "log_uniform" else least if operation == "scale" else ""
    fits = second >= 0 if gaussian else first <= second
    fits = fits and not (least == "above 0" and first <= 0) and not (least == "at least 0" and first < 0)
    form = "[mean, standard deviation]" if gaussian else "[low, high]"
    return None if fits else form + (least and f", {least}")


def ranges(
    above_0: Sequence[str] = (), at_least_0: Sequence[str] = (), free: Sequence[str] = ()
) -> Callable[[Mapping[str, Any]], Iterator[Broken]]:
    """Return the rule that holds pairs against operation and distribution.

    Args:
        above_0: names of pairs whose factors must be above 0.
        at_least_0: names of pairs whose factors must not be below 0.
        free: names of pairs whose factors may be anything.
    """
    bounds = dict.fromkeys(above_0, "above 0") | dict.fromkeys(at_least_0, "at least 0") | dict.fromkeys(free, "")

    def rule(given: Mapping[str, Any]) -> Iterator[Broken]:
        for name, least in bounds.items():
            pair = given[name]
            if pair and (expected := pair_error(pair, given["operation"], given["distribution"], least)):
                yield Broken(name, f"{pair!r} is out of range", expected)

    return rule
