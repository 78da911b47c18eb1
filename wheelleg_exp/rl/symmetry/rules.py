"""How each kind of observation turns in a mirror in the plane of the base's x and z axes."""

from __future__ import annotations

from collections.abc import Mapping

# The signs of rows of fixed width, by rule.
SIGNS: Mapping[str, tuple[float, ...]] = {
    "vector": (1, -1, 1),  # velocity, acceleration, force, gravity
    "pseudovector": (-1, 1, -1),  # angular velocity, torque
    "planar_velocity": (1, -1, -1),  # forwards, to the left, yaw rate
    "quaternion": (1, -1, 1, -1),
    "roll_pitch": (-1, 1),
}
# Rules of any width: what does not change; a number, or a sine and then a cosine, of each joint; raw actions.
OTHERS = ("invariant", "joints", "joints_sin_cos", "actions")
COMMAND = "command"  # stands for the rule of the command's class
NAMES = (*SIGNS, *OTHERS)

_OBSERVATIONS = "wheelleg_exp.mdp.observations"
# Stock observations by the name of their function.
OF_TERMS: Mapping[str, str] = {
    "base_lin_vel": "vector",
    "root_link_lin_vel": "vector",
    "projected_gravity": "vector",
    "root_pos_w": "vector",
    "root_lin_vel_w": "vector",
    "base_ang_vel": "pseudovector",
    "root_ang_vel_w": "pseudovector",
    "root_quat_w": "quaternion",
    "base_roll_pitch": "roll_pitch",
    "base_pos_z": "invariant",
    "base_height": "invariant",
    "current_time_s": "invariant",
    "remaining_time_s": "invariant",
    "joint_pos": "joints",
    "joint_pos_rel": "joints",
    "joint_pos_limit_normalized": "joints",
    "joint_vel": "joints",
    "joint_vel_rel": "joints",
    "joint_acc": "joints",
    "joint_effort": "joints",
    "joint_effort_commanded": "joints",
    "joint_pos_sin_cos": "joints_sin_cos",
    "last_action": "actions",
    "generated_commands": COMMAND,
}
# Stock commands by the name of their class.
OF_COMMANDS: Mapping[str, str] = {
    "UniformVelocityCommand": "planar_velocity",
    "NormalVelocityCommand": "planar_velocity",
}


def known(target: str) -> str | None:
    """Return the rule of a stock observation by its dotted name; None when there is none."""
    module, _, name = target.rpartition(".")
    return OF_TERMS.get(name) if f"{module}.".startswith(f"{_OBSERVATIONS}.") else None
