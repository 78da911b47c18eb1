"""The drives as numbers, joint by joint: gains, limits, and by which law torque follows from targets."""

from __future__ import annotations

from typing import Any

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.sim import actuators

_LAWS = {
    actuators.ImplicitActuator: "implicit",
    actuators.IdealPDActuator: "pd",
    actuators.DelayedPDActuator: "pd",
    actuators.DCMotor: "dc_motor",
}
_NUMBERS = ("stiffness", "damping", "effort_limit", "velocity_limit")


def drive_specs(env: ManagerBasedRLEnv) -> list[dict[str, Any]]:
    """Return the actuator groups in order.

    ``law`` is ``implicit`` (a spring and a damper inside the solver, clipped to the effort limit), ``pd`` (the same of
    the state before each physics step), ``dc_motor`` (behind a motor's line), or null: no simulation but training's
    has it.
    """
    found = []
    for name, group in env.scene.robot.actuators.items():
        node = env.cfg["robot"]["actuators"][name]
        numbers = {key: [finite(value) for value in getattr(group, key)[0].tolist()] for key in _NUMBERS}
        spec: dict[str, Any] = {"name": name, "law": law(group), "class": type(group).__name__}
        spec |= {"joint_names": list(group.joint_names), "joint_ids": group.joint_ids.tolist(), **numbers}
        spec |= {"saturation_effort": node.get("saturation_effort")}
        delay = node.get("delay") or ([node["min_delay"], node["max_delay"]] if "max_delay" in node else None)
        found.append(spec | {"trained_with": {"delay_steps": delay}})
    return found


def law(group: actuators.ActuatorBase) -> str | None:
    """Return by which law a group turns targets into torques, or None for one that no runner knows."""
    return _LAWS.get(type(group))


def per_joint(env: ManagerBasedRLEnv, drives: list[dict[str, Any]]) -> dict[str, list[float | None]]:
    """Return gains and limits of every joint in the robot's order; a joint without a drive has gains 0, no limits."""
    count = len(env.scene.robot.joint_names)
    found: dict[str, list[float | None]] = {key: [0.0 if key in _NUMBERS[:2] else None] * count for key in _NUMBERS}
    for drive in drives:
        for key in _NUMBERS:
            for joint, value in zip(drive["joint_ids"], drive[key], strict=True):
                found[key][joint] = value
    return found


def finite(value: float) -> float | None:
    """Return a number, or None in place of what JSON does not have."""
    return value if abs(value) < float("inf") else None
