"""The drives as numbers, joint by joint: gains, limits, and by which law torque follows from targets."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.lint.robot_facts import at_default
from wheelleg_exp.sim import actuators

_LAWS = {
    actuators.ImplicitActuator: "implicit",
    actuators.IdealPDActuator: "pd",
    actuators.DelayedPDActuator: "pd",
    actuators.DCMotor: "dc_motor",
}
_RATE_MARGIN = 10.0
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
    """Return gains and limits of every joint in the robot's order, and what it is; without a drive gains are 0.

    ``inertia`` is of the parts about the joint's axis, without ``armature``. ``drive_rate`` (Hz) is how often a drive
    must compute its torque: each physics step, and ten times as often as stability needs (kp·dt² + 2·kd·dt < 4·I).
    """
    robot = env.scene.robot
    count = len(robot.joint_names)
    found: dict[str, list[float | None]] = {key: [0.0 if key in _NUMBERS[:2] else None] * count for key in _NUMBERS}
    for drive in drives:
        for key in _NUMBERS:
            for joint, value in zip(drive["joint_ids"], drive[key], strict=True):
                found[key][joint] = value
    model, dofs = env.scene.sim.model, robot.layout.dof_ids.tolist()
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, at_default(model, robot), matrix)
    fields = {"armature": model.dof_armature, "friction": model.dof_frictionloss, "viscous_friction": model.dof_damping}
    fields["inertia"] = matrix.diagonal() - model.dof_armature
    found |= {name: values[dofs].tolist() for name, values in fields.items()}
    effective = 1.0 / np.linalg.inv(matrix).diagonal()[dofs]  # what a torque meets while everything else can move
    kp, kd = (np.array([value or 0.0 for value in found[key]]) for key in _NUMBERS[:2])
    least = (kd + np.sqrt(kd**2 + 4 * kp * effective)) / (4 * effective)
    found["drive_rate"] = np.maximum(_RATE_MARGIN * least, 1 / env.physics_dt).tolist()
    return found


def finite(value: float) -> float | None:
    """Return a number, or None in place of what JSON does not have."""
    return value if abs(value) < float("inf") else None
