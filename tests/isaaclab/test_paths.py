"""Isaac Lab's dotted paths can be imported, each in a process that has imported nothing else of the package."""

import subprocess
import sys

import pytest
import torch

pytestmark = pytest.mark.slow

PATHS = {
    "actuators": "ImplicitActuator DCMotor",
    "assets": "Articulation ArticulationData AssetBase RigidObject RigidObjectCollection RigidObjectData",
    "assets.articulation": "Articulation ArticulationData",
    "assets.articulation.articulation": "Articulation",
    "assets.rigid_object": "RigidObject RigidObjectData",
    "envs": "ManagerBasedEnv ManagerBasedRLEnv mdp",
    "envs.manager_based_rl_env": "ManagerBasedRLEnv",
    "envs.mdp": "JointPositionAction UniformVelocityCommand modify_term_cfg joint_pos_rel base_height_l2 time_out",
    "envs.mdp.actions": "JointPositionAction",
    "envs.mdp.actions.joint_actions": "JointPositionAction",
    "envs.mdp.commands": "UniformVelocityCommand",
    "envs.mdp.curriculums": "modify_term_cfg",
    "envs.mdp.events": "reset_joints_by_scale push_by_setting_velocity",
    "envs.mdp.observations": "joint_effort",
    "envs.mdp.rewards": "base_height_l2 body_lin_acc_l2",
    "envs.mdp.terminations": "time_out",
    "managers": "SceneEntityCfg ActionTerm CommandTermCfg RewardTermCfg RewardManager ManagerTermBase",
    "managers.action_manager": "ActionTerm",
    "managers.command_manager": "CommandTerm",
    "managers.manager_base": "ManagerTermBase",
    "managers.manager_term_cfg": "RewardTermCfg ActionTermCfg",
    "managers.scene_entity_cfg": "SceneEntityCfg",
    "markers": "VisualizationMarkers VisualizationMarkersCfg",
    "scene": "InteractiveScene",
    "sensors": "Camera ContactSensor Imu RayCaster TiledCamera",
    "sensors.contact_sensor": "ContactSensor",
    "sensors.ray_caster": "RayCaster",
    "sim": "SimulationContext",
    "terrains": "TerrainImporter",
    "utils": "configclass math string",
    "utils.buffers": "CircularBuffer DelayBuffer",
    "utils.configclass": "configclass",
    "utils.math": "quat_mul wrap_to_pi sample_uniform",
    "utils.modifiers": "Integrator DigitalFilter",
    "utils.noise": "NoiseModelWithAdditiveBias ConstantNoise",
    "utils.string": "resolve_matching_names",
}

# Each fork executes one text; the imports of third-party packages cost 2 s, and the forks share them.
FORKS = """
import os, sys
import mujoco, torch

assert not [name for name in sys.modules if name.startswith("wheelleg_exp")]
for code in sys.argv[1:]:
    if not (child := os.fork()):
        exec(code, {})
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit(code)
"""


def test_every_path_has_its_names_and_can_be_imported_before_the_package():
    lines = [f"from wheelleg_exp.isaaclab.{path} import {', '.join(names.split())}" for path, names in PATHS.items()]
    firsts = [f"import wheelleg_exp.isaaclab.{path}" for path in ("managers.command_manager", "envs.mdp.rewards")]
    firsts.append("from wheelleg_exp.isaaclab_tasks.manager_based.locomotion.velocity.mdp import feet_slide")
    firsts.append("from wheelleg_exp.isaaclab_tasks.manager_based.locomotion.velocity.mdp.rewards import feet_air_time")
    firsts.append("from wheelleg_exp.isaaclab.sensors.contact_sensor.contact_sensor import ContactSensor")
    subprocess.run([sys.executable, "-c", FORKS, "\n".join(lines), *firsts], check=True)


def test_private_helpers_of_isaac_lab_that_terms_import():
    from wheelleg_exp.isaaclab.envs.mdp.events import _randomize_prop_by_op
    from wheelleg_exp.isaaclab.envs.utils.io_descriptors import generic_io_descriptor, record_shape

    @generic_io_descriptor(observation_type="JointState", on_inspect=[record_shape])
    def term(env):
        return env + 1

    assert term(1) == 2
    data, rows = torch.ones(4, 3), torch.tensor([0, 2])
    changed = _randomize_prop_by_op(data, (2.0, 3.0), rows, [1], operation="scale", distribution="uniform")
    assert changed is data
    assert ((data[rows, 1] >= 2.0) & (data[rows, 1] <= 3.0)).all()
    assert int((data != 1.0).sum()) == 2
    _randomize_prop_by_op(data, (5.0, 5.0), None, slice(None), operation="abs", distribution="uniform")
    assert (data == 5.0).all()
