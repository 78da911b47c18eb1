"""How each kind of observation turns in a mirror in the plane of the base's x and z axes."""

from __future__ import annotations

from collections.abc import Mapping

from wheelleg_exp.errors import ConfigError, nearest_name

TERMS = "agent.symmetry.terms"
# The signs of rows of fixed width, by rule.
SIGNS: Mapping[str, tuple[float, ...]] = {
    "vector": (1, -1, 1),  # velocity, acceleration, force, gravity
    "pseudovector": (-1, 1, -1),  # angular velocity, torque
    "planar_velocity": (1, -1, -1),  # forwards, to the left, yaw rate
    "quaternion": (1, -1, 1, -1),
    "roll_pitch": (-1, 1),
    "travel": (1, -1),  # forwards, turned
    "place": (1, -1, 1, -1),  # the way to a place, and the turn that is left
    "base_pose": (1, -1, 1),  # height, roll, pitch
    "pose": (1, -1, 1, 1, -1, 1, -1),  # position and quaternion
}
# Rules of any width: what does not change; a number, or a sine and then a cosine, of each joint; raw actions; sines and
# cosines of a gait's clock; a number of each ray.
OTHERS = ("invariant", "joints", "joints_sin_cos", "actions", "phases", "rays")
# Rules of some numbers a body: their signs, the parameter that chooses the bodies, whether their axes must be images.
OF_BODIES: Mapping[str, tuple[tuple[float, ...], str, bool]] = {
    "sensed_bodies": ((1,), "sensor_cfg", False),
    "sensed_body_vectors": ((1, -1, 1), "sensor_cfg", False),
    "bodies": ((1,), "asset_cfg", False),
    "body_vectors": ((1, -1, 1), "asset_cfg", True),
    "body_poses": ((1, -1, 1, 1, -1, 1, -1), "asset_cfg", True),
}
# Rules of what an IMU measures in its own axes.
OF_IMUS: Mapping[str, str] = {
    "imu_vector": "vector",
    "imu_pseudovector": "pseudovector",
    "imu_quaternion": "quaternion",
}
COMMAND = "command"  # stands for the rule of the command's class
NAMES = (*SIGNS, *OTHERS, *OF_BODIES, *OF_IMUS)

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
    "travel_error": "travel",
    "gait_phase": "phases",
    "height_scan": "rays",
    "imu_orientation": "imu_quaternion",
    "imu_projected_gravity": "imu_vector",
    "imu_ang_vel": "imu_pseudovector",
    "imu_lin_acc": "imu_vector",
    "body_contacts": "sensed_bodies",
    "body_air_time": "sensed_bodies",
    "body_contact_forces": "sensed_body_vectors",
    "body_pose_w": "body_poses",
    "body_projected_gravity_b": "body_vectors",
}
# Stock commands by the name of their class.
OF_COMMANDS: Mapping[str, str] = {
    "UniformVelocityCommand": "planar_velocity",
    "UniformVelocityTravelCommand": "planar_velocity",
    "NormalVelocityCommand": "planar_velocity",
    "UniformPose2dCommand": "place",
    "UniformBasePoseCommand": "base_pose",
    "UniformPoseCommand": "pose",
    "NullCommand": "invariant",
}


def known(target: str) -> str | None:
    """Return the rule of a stock observation by its dotted name; None when there is none."""
    module, _, name = target.rpartition(".")
    return OF_TERMS.get(name) if f"{module}.".startswith(f"{_OBSERVATIONS}.") else None


def unknown(rule: str, term: str) -> ConfigError:
    """Return what is told of a rule that there is not."""
    expected, nearest = "one of " + ", ".join(NAMES), nearest_name(rule, NAMES)
    return ConfigError(f"'{rule}' is no rule", key=f"{TERMS}.{term}", expected=expected, nearest=nearest)
