"""Event terms.

Names and behaviour are Isaac Lab's. A term whose name there is misleading has a second, explicit name.

| module | what it changes |
|---|---|
| `randomization` | materials, masses, inertias, centres of mass, joints, gravity |
| `disturbances` | wrenches and pushes |
| `resets` | the state at the start of episodes |
"""

from wheelleg_exp.mdp.events.disturbances import (
    apply_body_impulse,
    apply_external_force_torque,
    push_by_adding_velocity,
    push_by_setting_velocity,
    set_permanent_body_wrench,
    set_root_velocity,
)
from wheelleg_exp.mdp.events.randomization import (
    draw,
    randomize_actuator_gains,
    randomize_effort_limits,
    randomize_encoder_bias,
    randomize_floor_slope,
    randomize_imu_errors,
    randomize_joint_parameters,
    randomize_physics_scene_gravity,
    randomize_rigid_body_com,
    randomize_rigid_body_com_cumulative,
    randomize_rigid_body_inertia,
    randomize_rigid_body_mass,
    randomize_rigid_body_material,
)
from wheelleg_exp.mdp.events.resets import (
    reset_joints_by_offset,
    reset_joints_by_scale,
    reset_root_state_from_terrain,
    reset_root_state_uniform,
    reset_root_state_with_random_orientation,
    reset_scene_to_default,
    reset_to_resting_pose,
)

# ``ABSENT`` gives the reason why an event term of Isaac Lab does not exist in this package.
ABSENT = {
    "randomize_rigid_body_scale": "Isaac Lab scales no articulation, and the robot is one",
    "randomize_rigid_body_collider_offsets": "MuJoCo's shapes have a margin and a gap instead, which an asset defines",
    "randomize_fixed_tendon_parameters": "a robot's tendons are not driven here",
    "randomize_visual_texture_material": "training renders no images",
    "randomize_visual_color": "training renders no images",
    "randomize_visual_material": "training renders no images",
    "randomize_visual_shape": "training renders no images",
    "reset_nodal_state_uniform": "there are no deformable bodies",
}
