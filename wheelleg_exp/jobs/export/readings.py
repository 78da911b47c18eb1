"""What a deployed robot is asked for: each reading's unit and meaning, and where training's simulation has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.mdp import observations as obs

COMMANDS = "commands."


@dataclass(frozen=True)
class Reading:
    """What one reading is.

    Attributes:
        unit: its unit.
        meaning: what it measures, in which axes.
        of: returns it from a simulation, (N, width).
    """

    unit: str
    meaning: str
    of: Callable[[ManagerBasedRLEnv], torch.Tensor]


READINGS = {
    "base_ang_vel": Reading("rad/s", "angular velocity of the base in its own axes: a gyroscope", obs.base_ang_vel),
    "projected_gravity": Reading(
        "1",
        "unit vector of gravity in the base's axes, upright (0, 0, -1); base_quat (w, x, y, z) may stand for it",
        obs.projected_gravity,
    ),
    "base_lin_vel": Reading(
        "m/s", "velocity of the base's centre of mass in its own axes: an estimate", obs.base_lin_vel
    ),
    "base_height": Reading("m", "height of the base above the ground below it: an estimate", obs.base_height),
    "joint_pos": Reading("rad", "joint positions, in the order of joint_names: encoders", obs.joint_pos),
    "joint_vel": Reading("rad/s", "joint velocities, in the order of joint_names", obs.joint_vel),
    "joint_effort": Reading("N·m", "torques of the drives, in the order of joint_names", obs.joint_effort_commanded),
}


# Of an IMU (``<sensor>.<quantity>``): its unit and meaning, and the attribute of the sensor's data.
QUANTITIES = {
    "ang_vel": ("rad/s", "angular velocity in its own axes", "ang_vel_b"),
    "lin_acc": ("m/s^2", "acceleration in its own axes; at rest it reads gravity upwards", "lin_acc_b"),
    "projected_gravity": ("1", "unit vector of gravity in its own axes", "projected_gravity_b"),
    "quat": ("1", "orientation in the world (w, x, y, z)", "quat_w"),
}


def reading(name: str) -> Reading:
    """Return what a reading is, also of a command (``commands.<term>``) or an IMU (``<sensor>.<quantity>``)."""
    if name in READINGS:
        return READINGS[name]
    if not name.startswith(COMMANDS):
        sensor, _, quantity = name.rpartition(".")
        unit, meaning, attribute = QUANTITIES[quantity]
        return Reading(
            unit, f"of the IMU '{sensor}': {meaning}", lambda env: getattr(env.scene[sensor].data, attribute)
        )
    term = name.removeprefix(COMMANDS)
    meaning = f"what the command '{term}' asks for; its components and ranges stand in commands.{term}"
    return Reading("m/s, rad/s", meaning, lambda env: env.command_manager.get_command(term))
