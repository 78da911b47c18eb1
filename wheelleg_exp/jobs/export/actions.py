"""Action terms as numbers that a runner works with: from the policy's output to joint targets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.export.drives import finite
from wheelleg_exp.mdp import actions

Spec = dict[str, Any]


def action_specs(env: ManagerBasedRLEnv) -> list[Spec]:
    """Return the action terms in order, each with its slice of the policy's output and its joints.

    Raises:
        ConfigError: a term is none of this package's.
    """
    manager, start, found = env.action_manager, 0, []
    for name, width in zip(manager.active_terms, manager.action_term_dim, strict=True):
        term, bound = manager.get_term(name), manager.get_term_cfg(name)
        known = _KNOWN.get(type(term))
        if known is None:
            raise ConfigError(
                f"a runner does not know the actions of '{bound.target}'",
                key=bound.path,
                expected="one of " + ", ".join(sorted(kind.__name__ for kind in _KNOWN)),
            )
        ids = torch.arange(len(env.scene.robot.joint_names))[term._ids].tolist()  # type: ignore[attr-defined]
        place = {"name": name, "start": start, "stop": start + width, "joint_names": list(term.joint_names)}
        spec = {**place, "joint_ids": ids, "drives": term.drives, **known(term), "clip": _clip(term)}
        # On a robot the way to the drives takes its own time.
        found.append(spec | {"trained_with": {"delay_steps": env.cfg["actions"][name].get("delay")}})
        start += width
    return found


def _clip(term: Any) -> list[list[float | None]] | None:
    """Return the bounds of each joint, null where there is none."""
    if term._low is None:
        return None
    return [[finite(low), finite(high)] for low, high in zip(term._low.tolist(), term._high.tolist(), strict=True)]


def _affine(term: Any, function: str = "affine") -> Spec:
    return {"function": function, "scale": term._scale.tolist(), "offset": term._offset[0].tolist()}


def _to_limits(term: Any) -> Spec:
    low, high = term._limits()
    limits = {"low": [*map(finite, low[0].tolist())], "high": [*map(finite, high[0].tolist())]}
    scale = {"scale": term._scale.tolist(), "offset": [0.0] * len(term._scale)}
    return {"function": "to_limits", **scale, "rescale": term._rescale, **limits}


def _ema(term: Any) -> Spec:
    return {**_to_limits(term), "alpha": term._alpha.tolist()}


def _binary(term: Any) -> Spec:
    threshold = {"threshold": 0.0, "strict": False, "opens_above": True}
    if isinstance(term, actions.AbsBinaryJointPositionAction):
        threshold = {"threshold": term._threshold, "strict": term._positive, "opens_above": term._positive}
    return {"function": "binary", **threshold, "open": term._open.tolist(), "close": term._close.tolist()}


_KNOWN: dict[type, Callable[[Any], Spec]] = {
    actions.JointPositionAction: _affine,
    actions.JointVelocityAction: _affine,
    actions.JointEffortAction: _affine,
    actions.RelativeJointPositionAction: lambda term: _affine(term, "relative"),
    actions.JointPositionToLimitsAction: _to_limits,
    actions.EMAJointPositionToLimitsAction: _ema,
    actions.BinaryJointPositionAction: _binary,
    actions.BinaryJointVelocityAction: _binary,
    actions.AbsBinaryJointPositionAction: _binary,
}
