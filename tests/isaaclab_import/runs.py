"""Write run folders in the form of Isaac Lab, for the stock robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml

ROBOT = Path(__file__).parents[2] / "assets/wheelleg/wheelleg.usda"
LEGS, WHEELS = ["l01", "r01", "l02", "r02"], ["l03", "r03"]

ENV = """
viewer: {eye: !!python/tuple [7.5, 7.5, 7.5]}
sim:
  device: cuda:0
  dt: 0.005
  render_interval: 4
  gravity: !!python/tuple [0.0, 0.0, -9.81]
  physx: {solver_type: 1, bounce_threshold_velocity: 0.5}
  physics_material:
    func: isaaclab.sim.spawners.materials.physics_materials:spawn_rigid_body_material
    static_friction: 0.9
    dynamic_friction: 0.8
    restitution: 0.0
    friction_combine_mode: multiply
seed: 42
decimation: 4
scene:
  num_envs: 4096
  env_spacing: 2.5
  replicate_physics: true
  robot:
    class_type: isaaclab.assets.articulation.articulation:Articulation
    prim_path: /World/envs/env_.*/Robot
    spawn:
      func: isaaclab.sim.spawners.from_files.from_files:spawn_from_usd
      usd_path: C:\\work\\robot.usd
      articulation_props: {enabled_self_collisions: false, fix_root_link: null, solver_position_iteration_count: 8}
      link_density: 1.0e-8
    init_state:
      pos: !!python/tuple [0.0, 0.0, 0.085]
      rot: !!python/tuple [1.0, 0.0, 0.0, 0.0]
      joint_pos: {'[lr]01': 0.9599, '[lr]02': -1.885, '.*03': 0.0}
      joint_vel: {.*: 0.0}
    soft_joint_pos_limit_factor: 0.9
    actuators:
      legs:
        class_type: isaaclab.actuators.actuator_pd:DCMotor
        joint_names_expr: ['.*0[12]']
        effort_limit: 2.0
        velocity_limit: 30.0
        effort_limit_sim: null
        saturation_effort: 4.0
        stiffness: {'.*01': 3.0, '.*02': 2.5}
        damping: 0.3
        armature: 0.05
        friction: 0.01
      wheels:
        class_type: isaaclab.actuators.actuator_pd:ImplicitActuator
        joint_names_expr: .*03
        effort_limit_sim: 9.0
        velocity_limit: null
        stiffness: 0.0
        damping: 1.0
  terrain:
    class_type: isaaclab.terrains.terrain_importer:TerrainImporter
    terrain_type: plane
    physics_material: {static_friction: 0.7, dynamic_friction: 0.6, friction_combine_mode: average}
  contact_forces:
    class_type: isaaclab.sensors.contact_sensor.contact_sensor:ContactSensor
    prim_path: /World/envs/env_.*/Robot/.*
    history_length: 3
    track_air_time: true
    force_threshold: 1.0
    update_period: 0.0
  sky_light: {class_type: null, spawn: {func: 'isaaclab.sim.spawners.lights.lights:spawn_light', intensity: 750.0}}
  cube: {class_type: 'isaaclab.assets.rigid_object.rigid_object:RigidObject'}
observations:
  policy:
    concatenate_terms: true
    enable_corruption: true
    history_length: null
    base_ang_vel:
      func: isaaclab.envs.mdp.observations:base_ang_vel
      params: {}
      noise: {func: 'isaaclab.utils.noise.noise_model:uniform_noise', operation: add, n_min: -0.2, n_max: 0.2}
      clip: !!python/tuple [-50.0, 50.0]
      scale: 0.25
      history_length: 0
    gravity: {func: 'isaaclab.envs.mdp.observations:projected_gravity', params: {}, history_length: 0}
    command:
      func: isaaclab.envs.mdp.observations:generated_commands
      params: {command_name: base_velocity}
    joint_pos:
      func: isaaclab.envs.mdp.observations:joint_pos_rel
      params:
        asset_cfg:
          name: robot
          joint_names: ['.*0[12]']
          joint_ids: !!python/object/apply:builtins.slice [null, null, null]
          body_names: null
          body_ids: !!python/object/apply:builtins.slice [null, null, null]
          preserve_order: false
    joint_vel: {func: 'isaaclab.envs.mdp.observations:joint_vel_rel', params: {}, scale: 0.05}
    actions: {func: 'isaaclab.envs.mdp.observations:last_action', params: {}}
    height: null
actions:
  legs:
    class_type: isaaclab.envs.mdp.actions.joint_actions:JointPositionAction
    asset_name: robot
    debug_vis: false
    clip: null
    joint_names: ['.*0[12]']
    scale: 0.15
    offset: 0.0
    use_default_offset: true
  wheels:
    class_type: isaaclab.envs.mdp.actions.joint_actions:JointVelocityAction
    asset_name: robot
    joint_names: ['.*03']
    scale: 5.0
    use_default_offset: true
events:
  add_base_mass:
    func: isaaclab.envs.mdp.events:randomize_rigid_body_mass
    params:
      asset_cfg: {name: robot, joint_names: null, body_names: base_link, preserve_order: false}
      mass_distribution_params: !!python/tuple [-0.01, 0.02]
      operation: add
    mode: startup
    interval_range_s: null
    is_global_time: false
    min_step_count_between_reset: 0
  reset_base:
    func: isaaclab.envs.mdp.events:reset_root_state_uniform
    params: {pose_range: {yaw: !!python/tuple [-0.1, 0.1]}, velocity_range: {}}
    mode: reset
  push:
    func: isaaclab.envs.mdp.events:push_by_setting_velocity
    params: {velocity_range: {x: [-0.1, 0.1]}}
    mode: interval
    interval_range_s: !!python/tuple [2.0, 3.0]
is_finite_horizon: false
episode_length_s: 5.0
rewards:
  track:
    func: isaaclab.envs.mdp.rewards:track_lin_vel_xy_exp
    params: {command_name: base_velocity, std: 0.5}
    weight: 1.5
  air_time:
    func: isaaclab_tasks.manager_based.locomotion.velocity.mdp.rewards:feet_air_time
    params:
      sensor_cfg: {name: contact_forces, joint_names: null, body_names: .*_wheel_link}
      command_name: base_velocity
      threshold: 0.25
    weight: 0.1
  own:
    func: my_lab.tasks.mdp.rewards:tilt_cost
    params: {power: 2.0}
    weight: -1.0
terminations:
  time_out: {func: 'isaaclab.envs.mdp.terminations:time_out', params: {}, time_out: true}
  fallen: {func: 'isaaclab.envs.mdp.terminations:bad_orientation', params: {limit_angle: 1.0}, time_out: false}
curriculum: {terrain_levels: null}
commands:
  base_velocity:
    class_type: isaaclab.envs.mdp.commands.velocity_command:UniformVelocityCommand
    resampling_time_range: !!python/tuple [4.0, 6.0]
    debug_vis: true
    asset_name: robot
    heading_command: false
    rel_standing_envs: 0.1
    ranges: {lin_vel_x: !!python/tuple [-0.3, 0.3], lin_vel_y: [0.0, 0.0], ang_vel_z: [-0.5, 0.5], heading: null}
    goal_vel_visualizer_cfg: {prim_path: /Visuals/goal}
"""
AGENT = """
seed: 42
num_steps_per_env: 24
max_iterations: 1500
save_interval: 50
obs_groups: {}
clip_actions: null
policy:
  class_name: ActorCritic
  init_noise_std: 0.8
  actor_hidden_dims: [32, 16]
  critic_hidden_dims: [24, 16]
  activation: elu
algorithm: {class_name: PPO, num_learning_epochs: 4, gamma: 0.98, entropy_coef: 0.01, rnd_cfg: null}
"""
TERMS = """
from __future__ import annotations

import torch
from isaaclab.managers import SceneEntityCfg
from isaaclab_tasks.manager_based.locomotion.velocity import mdp
from .helpers import squared as power_two
from typing import TYPE_CHECKING
import pandas

if TYPE_CHECKING:
    from isaaclab.envs import ManagerBasedRLEnv

FACTOR = 0.5


def tilt_cost(env: ManagerBasedRLEnv, power: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")):
    return FACTOR * power * power_two(env.scene[asset_cfg.name].data.projected_gravity_b[:, :2]).sum(1)


def failing(env):
    return undefined_name + env.num_envs


def unused(env):
    return pandas.DataFrame()
"""
HELPERS = "import torch\n\n\ndef squared(x):\n    return torch.square(x)\n"


def network(inputs: int, hidden: list[int], outputs: int) -> torch.nn.Sequential:
    """Return a multilayer perceptron as rsl_rl builds it."""
    layers: list[torch.nn.Module] = []
    for a, b in zip([inputs, *hidden], [*hidden, outputs], strict=True):
        layers += [torch.nn.Linear(a, b), torch.nn.ELU()]
    return torch.nn.Sequential(*layers[:-1])


class ActorCritic(torch.nn.Module):
    """The networks of rsl_rl 2 and 3, with their names."""

    def __init__(self, inputs: int = 25, actions: int = 6) -> None:
        super().__init__()
        self.actor, self.critic = network(inputs, [32, 16], actions), network(inputs, [24, 16], 1)
        self.std = torch.nn.Parameter(torch.full((actions,), 0.3))


class Exported(torch.nn.Module):
    """A policy as Isaac Lab exports it."""

    def __init__(self, actor: torch.nn.Module, normalizer: torch.nn.Module) -> None:
        super().__init__()
        self.actor, self.normalizer = actor, normalizer

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.actor(self.normalizer(x))


class Normalizer(torch.nn.Module):
    """rsl_rl's normalization of observations."""

    def __init__(self, inputs: int = 25) -> None:
        super().__init__()
        self.register_buffer("_mean", torch.randn(1, inputs))
        self.register_buffer("_var", torch.rand(1, inputs) + 0.5)
        self.register_buffer("_std", self._var.sqrt())
        self.register_buffer("count", torch.tensor(5000))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x - self._mean) / (self._std + 1e-2)


def checkpoint(policy: ActorCritic, iteration: int = 700) -> dict[str, Any]:
    """Return a checkpoint of rsl_rl 2."""
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.001)
    policy.critic(policy.actor[0].weight.new_ones(1, 25)).sum().backward()
    policy.actor(torch.ones(1, 25)).sum().backward()
    policy.std.grad = torch.ones(6)
    optimizer.step()
    states = {"model_state_dict": policy.state_dict(), "optimizer_state_dict": optimizer.state_dict()}
    return {**states, "iter": iteration, "infos": None}


def write_run(folder: Path, env: str = ENV, agent: str | None = AGENT) -> tuple[Path, ActorCritic]:
    """Write an Isaac Lab run with a checkpoint, and return its folder and its networks."""
    torch.manual_seed(3)
    (folder / "params").mkdir(parents=True)
    (folder / "params/env.yaml").write_text(env)
    if agent is not None:
        (folder / "params/agent.yaml").write_text(agent)
    policy = ActorCritic()
    torch.save(checkpoint(policy), folder / "model_700.pt")
    return folder, policy


def write_terms(folder: Path) -> Path:
    """Write the author's Python code."""
    place = folder / "source/my_lab/tasks/mdp"
    place.mkdir(parents=True)
    (place / "rewards.py").write_text(TERMS)
    (place / "helpers.py").write_text(HELPERS)
    (place / "broken.py").write_text("def (")
    return folder


def changed(text: str, key: str, value: Any) -> str:
    """Return ``ENV`` with another value at a dotted key; Python's tags are kept as lists."""
    from wheelleg_exp.plain_data import tagged_yaml_value

    tree = tagged_yaml_value(text)
    *parents, last = key.split(".")
    node = tree
    for parent in parents:
        node = node[parent]
    if value is None:
        del node[last]
    else:
        node[last] = value
    return yaml.safe_dump(tree, sort_keys=False)
