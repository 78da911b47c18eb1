"""One thing of the world changed at a time, the same for every episode: what a policy bears."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from wheelleg_exp.evaluation.options import Robust
from wheelleg_exp.evaluation.rollout import Policy

_EVENTS = "wheelleg_exp.mdp.events"


@dataclass(frozen=True)
class World:
    """A change of the world.

    Attributes:
        sweep: what is changed.
        value: to what.
        cfg: the changed ``env`` section.
        late: control steps by which actions come late.
    """

    sweep: str
    value: float
    cfg: dict[str, Any] = field(repr=False)
    late: int = 0


def worlds(cfg: Mapping[str, Any], options: Robust, base: str, step_dt: float) -> Iterator[World]:
    """Yield the unchanged world (``nominal``) and each changed one.

    Masses, centres of mass, gains and friction are set by events after the task's own of the same kind, whose draws
    they replace; noise is added to the terms that ``noise_std`` names, in place of their own.

    Args:
        cfg: the ``env`` section of the evaluation.
        options: the values.
        base: name of the root link.
        step_dt: the control step, s.
    """
    yield World("nominal", 0.0, copy.deepcopy(dict(cfg)))
    for value in options.friction:
        changed = _with_event(cfg, "friction", _friction(value))
        changed["scene"]["terrain"] |= {"static_friction": value, "dynamic_friction": value}
        yield World("friction", value, changed)
    for value in options.mass:
        yield World("mass", value, _with_event(cfg, "mass", _mass(value)))
    for value in options.com:
        yield World("com", value, _with_event(cfg, "com", _com(value, base)))
    for value in options.gains:
        yield World("gains", value, _with_event(cfg, "gains", _gains(value)))
    for value in options.noise:
        yield World("noise", value, _noisy(cfg, value, options.noise_std))
    for value in options.delay_s:
        yield World("delay", value, copy.deepcopy(dict(cfg)), round(value / step_dt))


def _with_event(cfg: Mapping[str, Any], name: str, node: dict[str, Any]) -> dict[str, Any]:
    changed = copy.deepcopy(dict(cfg))
    changed["events"] = {**changed["events"], f"evaluation_{name}": {"mode": "startup", **node}}
    return changed


def _on(**which: Any) -> dict[str, Any]:
    return {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", **which}


def _friction(value: float) -> dict[str, Any]:
    return {
        "_target_": f"{_EVENTS}.randomize_rigid_body_material",
        "static_friction_range": [value, value],
        "dynamic_friction_range": [value, value],
        "restitution_range": [0.0, 0.0],
        "num_buckets": 1,
        "asset_cfg": _on(body_names=[".*"]),
    }


def _mass(value: float) -> dict[str, Any]:
    return {
        "_target_": f"{_EVENTS}.randomize_rigid_body_mass",
        "mass_distribution_params": [value, value],
        "operation": "scale",
        "asset_cfg": _on(body_names=[".*"]),
    }


def _com(value: float, base: str) -> dict[str, Any]:
    return {
        "_target_": f"{_EVENTS}.randomize_rigid_body_com",
        "com_range": {"x": [value, value], "y": [0.0, 0.0], "z": [0.0, 0.0]},
        "asset_cfg": _on(body_names=[base]),
    }


def _gains(value: float) -> dict[str, Any]:
    return {
        "_target_": f"{_EVENTS}.randomize_actuator_gains",
        "stiffness_distribution_params": [value, value],
        "damping_distribution_params": [value, value],
        "operation": "scale",
        "asset_cfg": _on(joint_names=[".*"]),
    }


def _noisy(cfg: Mapping[str, Any], factor: float, deviations: Mapping[str, float]) -> dict[str, Any]:
    changed = copy.deepcopy(dict(cfg))
    for group in changed["observations"].values():
        corrupts = bool(group.get("enable_corruption", False))
        group["enable_corruption"] = True
        for node in group["terms"].values():
            name = str(node["_target_"]).rpartition(".")[2]
            if name in deviations:
                std = factor * deviations[name]
                node["noise"] = {"_target_": "wheelleg_exp.mdp.noise.GaussianNoise", "mean": 0.0, "std": std}
            elif not corrupts:
                node["noise"] = None
    return changed


class Late:
    """A policy whose actions come late by whole control steps; zeros come first.

    Args:
        policy: the policy.
        steps: by how many.
    """

    def __init__(self, policy: Policy, steps: int) -> None:
        self._policy, self._steps = policy, steps
        self._waiting: list[torch.Tensor] = []

    def reset(self) -> None:
        """Forget what is under way."""
        self._waiting = []
        reset: Callable[[], None] | None = getattr(self._policy, "reset", None)
        if reset is not None:
            reset()

    def __call__(self, observations: Mapping[str, Any]) -> torch.Tensor:
        """Return the actions that were decided on ``steps`` ago."""
        actions = self._policy(observations)
        self._waiting.append(actions)
        return self._waiting.pop(0) if len(self._waiting) > self._steps else torch.zeros_like(actions)
