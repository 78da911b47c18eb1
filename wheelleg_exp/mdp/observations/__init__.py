"""Observation terms, (N, width).

| module | what it observes |
|---|---|
| `root` | place, orientation and motion of the root |
| `joints` | positions, velocities and efforts of joints |
| `bodies` | single bodies |
| `sensors` | height scans, IMUs, contacts, pictures |
| `task` | actions, commands, times, phases |
"""

from wheelleg_exp.mdp.observations.bodies import body_pose_w, body_projected_gravity_b
from wheelleg_exp.mdp.observations.joints import (
    joint_acc,
    joint_effort,
    joint_effort_commanded,
    joint_pos,
    joint_pos_limit_normalized,
    joint_pos_rel,
    joint_pos_sin_cos,
    joint_vel,
    joint_vel_rel,
)
from wheelleg_exp.mdp.observations.root import (
    base_ang_vel,
    base_height,
    base_lin_vel,
    base_pos_z,
    base_roll_pitch,
    projected_gravity,
    root_ang_vel_w,
    root_lin_vel_w,
    root_link_lin_vel,
    root_pos_w,
    root_quat_w,
)
from wheelleg_exp.mdp.observations.sensors import (
    body_air_time,
    body_contact_forces,
    body_contacts,
    height_scan,
    image,
    imu_ang_vel,
    imu_lin_acc,
    imu_orientation,
    imu_projected_gravity,
)
from wheelleg_exp.mdp.observations.task import (
    current_time_s,
    gait_phase,
    generated_commands,
    last_action,
    remaining_time_s,
    travel_error,
)

__all__ = [
    "base_ang_vel",
    "base_height",
    "base_lin_vel",
    "base_pos_z",
    "base_roll_pitch",
    "body_air_time",
    "body_contact_forces",
    "body_contacts",
    "body_pose_w",
    "body_projected_gravity_b",
    "current_time_s",
    "gait_phase",
    "generated_commands",
    "height_scan",
    "image",
    "imu_ang_vel",
    "imu_lin_acc",
    "imu_orientation",
    "imu_projected_gravity",
    "joint_acc",
    "joint_effort",
    "joint_effort_commanded",
    "joint_pos",
    "joint_pos_limit_normalized",
    "joint_pos_rel",
    "joint_pos_sin_cos",
    "joint_vel",
    "joint_vel_rel",
    "last_action",
    "projected_gravity",
    "remaining_time_s",
    "root_ang_vel_w",
    "root_lin_vel_w",
    "root_link_lin_vel",
    "root_pos_w",
    "root_quat_w",
    "travel_error",
]
