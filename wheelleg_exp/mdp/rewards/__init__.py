"""Reward terms, (N,), before weight and time step. Formulas are Isaac Lab's unless the text says otherwise.

| module | what it rewards |
|---|---|
| `episode` | going on, and the episode's end |
| `root` | motion and pose of the root, acceleration of bodies |
| `joints` | joints: motion, effort, pose, limits |
| `actions` | raw actions |
| `contacts` | contact forces |
| `feet`, `wheels` | steps of feet, rolling of wheels |
| `tracking` | following commands |
"""

from wheelleg_exp.mdp.rewards.actions import action_acceleration_l2, action_l2, action_rate_l2
from wheelleg_exp.mdp.rewards.contacts import (
    contact_forces,
    desired_contacts,
    no_contact_count,
    no_desired_contact,
    undesired_contacts,
)
from wheelleg_exp.mdp.rewards.episode import is_alive, is_terminated, is_terminated_term
from wheelleg_exp.mdp.rewards.feet import (
    air_time_variance,
    feet_air_time,
    feet_air_time_positive_biped,
    feet_clearance_l2,
    feet_slide,
    feet_stumble,
)
from wheelleg_exp.mdp.rewards.joints import (
    applied_torque_limits,
    joint_acc_l2,
    joint_deviation_l1,
    joint_pos_limits,
    joint_power,
    joint_symmetry_l1,
    joint_torques_l2,
    joint_vel_l1,
    joint_vel_l2,
    joint_vel_limits,
    joint_vel_rate_l2,
    stand_still_joint_deviation_l1,
)
from wheelleg_exp.mdp.rewards.root import (
    ang_vel_xy_l2,
    base_height_exp,
    base_height_l2,
    base_height_over_ground_l2,
    body_lin_acc_l2,
    body_lin_acc_norm_sum,
    flat_orientation_exp,
    flat_orientation_l2,
    lin_vel_z_l2,
    pitch_orientation_l2,
    upward,
)
from wheelleg_exp.mdp.rewards.tracking import (
    track_ang_vel_z_exp,
    track_ang_vel_z_world_exp,
    track_base_height_exp,
    track_base_tilt_exp,
    track_lin_vel_xy_exp,
    track_lin_vel_xy_yaw_frame_exp,
    travel_error_l2,
)
from wheelleg_exp.mdp.rewards.wheels import wheel_slip, wheel_spin_in_air_l1

__all__ = [
    "action_acceleration_l2",
    "action_l2",
    "action_rate_l2",
    "air_time_variance",
    "ang_vel_xy_l2",
    "applied_torque_limits",
    "base_height_exp",
    "base_height_l2",
    "base_height_over_ground_l2",
    "body_lin_acc_l2",
    "body_lin_acc_norm_sum",
    "contact_forces",
    "desired_contacts",
    "feet_air_time",
    "feet_air_time_positive_biped",
    "feet_clearance_l2",
    "feet_slide",
    "feet_stumble",
    "flat_orientation_exp",
    "flat_orientation_l2",
    "is_alive",
    "is_terminated",
    "is_terminated_term",
    "joint_acc_l2",
    "joint_deviation_l1",
    "joint_pos_limits",
    "joint_power",
    "joint_symmetry_l1",
    "joint_torques_l2",
    "joint_vel_l1",
    "joint_vel_l2",
    "joint_vel_limits",
    "joint_vel_rate_l2",
    "lin_vel_z_l2",
    "no_contact_count",
    "no_desired_contact",
    "pitch_orientation_l2",
    "stand_still_joint_deviation_l1",
    "track_ang_vel_z_exp",
    "track_ang_vel_z_world_exp",
    "track_base_height_exp",
    "track_base_tilt_exp",
    "track_lin_vel_xy_exp",
    "track_lin_vel_xy_yaw_frame_exp",
    "travel_error_l2",
    "undesired_contacts",
    "upward",
    "wheel_slip",
    "wheel_spin_in_air_l1",
]
