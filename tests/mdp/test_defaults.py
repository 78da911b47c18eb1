"""The defaults of terms are those of Isaac Lab 2.3.2, written down by hand."""

import inspect

import pytest

from wheelleg_exp.mdp import actions, commands, curriculums, events, noise, observations, rewards, terminations
from wheelleg_exp.sim.sensors import RayCaster
from wheelleg_exp.terms.config_sections import ObservationGroup

JOINTS = {"scale": 1.0, "offset": 0.0, "clip": None, "preserve_order": False}
TO_LIMITS = {"scale": 1.0, "clip": None, "rescale_to_limits": True, "preserve_order": False}
HEADINGS = {"heading_command": False, "heading_control_stiffness": 1.0, "rel_standing_envs": 0.0}
HEADINGS |= {"rel_heading_envs": 1.0}
HISTORY = {"history_length": None, "flatten_history_dim": True}
DRAWN = {"operation": "abs", "distribution": "uniform"}
DEFAULTS = {
    actions.JointPositionAction: JOINTS | {"use_default_offset": True},
    actions.JointVelocityAction: JOINTS | {"use_default_offset": True},
    actions.RelativeJointPositionAction: JOINTS | {"use_zero_offset": True},
    actions.JointEffortAction: JOINTS,
    actions.JointPositionToLimitsAction: TO_LIMITS,
    actions.EMAJointPositionToLimitsAction: TO_LIMITS | {"alpha": 1.0},
    commands.UniformVelocityCommand: HEADINGS,
    events.randomize_rigid_body_material: {"make_consistent": False},
    events.randomize_rigid_body_mass: {"distribution": "uniform", "recompute_inertia": True, "min_mass": 1e-6},
    events.randomize_actuator_gains: DRAWN,
    events.randomize_joint_parameters: DRAWN,
    events.randomize_physics_scene_gravity: {"distribution": "uniform"},
    events.reset_scene_to_default: {"reset_joint_targets": False},
    noise.ConstantNoise: {"bias": 0.0, "operation": "add"},
    noise.UniformNoise: {"n_min": -1.0, "n_max": 1.0, "operation": "add"},
    noise.GaussianNoise: {"mean": 0.0, "std": 1.0, "operation": "add"},
    noise.NoiseModelWithAdditiveBias: {"sample_bias_per_component": True},
    observations.height_scan: {"offset": 0.5},
    observations.root_quat_w: {"make_quat_unique": False},
    rewards.is_terminated_term: {"term_keys": ".*"},
    rewards.desired_contacts: {"threshold": 1.0},
    terminations.command_resample: {"num_resamples": 1},
    terminations.terrain_out_of_bounds: {"distance_buffer": 3.0},
    RayCaster: {"ray_alignment": "base", "max_distance": 1e6, "drift_range": (0.0, 0.0), "update_period": 0.0},
    ObservationGroup: {"concatenate_terms": True, "concatenate_dim": -1, "enable_corruption": False} | HISTORY,
}


@pytest.mark.parametrize("target", DEFAULTS, ids=lambda target: target.__name__)
def test_a_default_is_isaac_labs(target):
    given = {name: parameter.default for name, parameter in inspect.signature(target).parameters.items()}
    assert {name: given[name] for name in DEFAULTS[target]} == DEFAULTS[target]


def test_isaac_labs_names_are_aliases():
    assert rewards.body_lin_acc_l2 is rewards.body_lin_acc_norm_sum
    assert rewards.desired_contacts is rewards.no_desired_contact
    assert events.push_by_setting_velocity is events.push_by_adding_velocity
    assert events.apply_external_force_torque is events.set_permanent_body_wrench
    assert events.randomize_rigid_body_com is events.randomize_rigid_body_com_cumulative
    assert curriculums.lin_vel_cmd_levels is curriculums.ang_vel_cmd_levels is curriculums.command_range_levels
