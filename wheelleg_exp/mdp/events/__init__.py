"""Event terms. Names and behaviour are Isaac Lab's; where its name misleads, an explicit one stands beside it.

| module | what it changes |
|---|---|
| `shapes`, `bodies` | materials; masses, inertias and centres of mass |
| `disturbances` | wrenches and pushes |
| `resets` | where episodes begin |
| `draws` | distributions and operations |
"""

from wheelleg_exp.mdp.events.bodies import (
    randomize_rigid_body_com,
    randomize_rigid_body_com_cumulative,
    randomize_rigid_body_mass,
)
from wheelleg_exp.mdp.events.disturbances import (
    apply_external_force_torque,
    push_by_adding_velocity,
    push_by_setting_velocity,
    set_permanent_body_wrench,
    set_root_velocity,
)
from wheelleg_exp.mdp.events.draws import draw
from wheelleg_exp.mdp.events.resets import (
    reset_joints_by_offset,
    reset_joints_by_scale,
    reset_root_state_uniform,
    reset_root_state_with_random_orientation,
    reset_scene_to_default,
)
from wheelleg_exp.mdp.events.shapes import randomize_rigid_body_material

__all__ = [
    "apply_external_force_torque",
    "draw",
    "push_by_adding_velocity",
    "push_by_setting_velocity",
    "randomize_rigid_body_com",
    "randomize_rigid_body_com_cumulative",
    "randomize_rigid_body_mass",
    "randomize_rigid_body_material",
    "reset_joints_by_offset",
    "reset_joints_by_scale",
    "reset_root_state_uniform",
    "reset_root_state_with_random_orientation",
    "reset_scene_to_default",
    "set_permanent_body_wrench",
    "set_root_velocity",
]
