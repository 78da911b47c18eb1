"""Reward terms, (N,), before weight and time step. Formulas are Isaac Lab's unless the text says otherwise.

| module | what it rewards |
|---|---|
| `episode` | going on, and the episode's end |
| `root` | motion and pose of the root |
| `joints` | joints: motion, effort, pose, limits |
| `actions` | raw actions |
| `contacts` | contact forces |
| `tracking` | following commands |
"""

from wheelleg_exp.mdp.rewards.actions import action_l2, action_rate_l2
from wheelleg_exp.mdp.rewards.contacts import (
    contact_forces,
    desired_contacts,
    no_contact_count,
    no_desired_contact,
    undesired_contacts,
)
from wheelleg_exp.mdp.rewards.episode import is_alive, is_terminated, is_terminated_term
from wheelleg_exp.mdp.rewards.joints import (
    applied_torque_limits,
    joint_acc_l2,
    joint_deviation_l1,
    joint_pos_limits,
    joint_symmetry_l1,
    joint_torques_l2,
    joint_vel_l1,
    joint_vel_l2,
    joint_vel_limits,
)
from wheelleg_exp.mdp.rewards.root import (
    ang_vel_xy_l2,
    base_height_l2,
    flat_orientation_l2,
    lin_vel_z_l2,
    pitch_orientation_l2,
)
from wheelleg_exp.mdp.rewards.tracking import track_ang_vel_z_exp, track_lin_vel_xy_exp

__all__ = [
    "action_l2",
    "action_rate_l2",
    "ang_vel_xy_l2",
    "applied_torque_limits",
    "base_height_l2",
    "contact_forces",
    "desired_contacts",
    "flat_orientation_l2",
    "is_alive",
    "is_terminated",
    "is_terminated_term",
    "joint_acc_l2",
    "joint_deviation_l1",
    "joint_pos_limits",
    "joint_symmetry_l1",
    "joint_torques_l2",
    "joint_vel_l1",
    "joint_vel_l2",
    "joint_vel_limits",
    "lin_vel_z_l2",
    "no_contact_count",
    "no_desired_contact",
    "pitch_orientation_l2",
    "track_ang_vel_z_exp",
    "track_lin_vel_xy_exp",
    "undesired_contacts",
]
