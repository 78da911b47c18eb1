"""Write the task file of a project, and the files of the terms that name links or joints of the robot."""

from __future__ import annotations

import math

from wheelleg_exp.lint.rule import at_most
from wheelleg_exp.project.robot_yaml import leg_gains, names, number, wheel_gains
from wheelleg_exp.project.survey import Survey

_ENTITY = "_target_: wheelleg_exp.managers.SceneEntityCfg"
_CONTACT = 0.02  # A force above 2 % of the robot's weight counts as a contact.
_FORCE = 0.02  # The constant random force on the trunk is at most 2 % of the robot's weight.
_TORQUE = 0.01  # The constant random torque on the trunk is at most 1 % of the robot's weight times the robot's size.
_LOAD = (-0.05, 0.1)  # An event adds between -5 % and 10 % of the trunk's mass to the trunk.
_ERROR = 0.2  # A height error of 20 % of the robot's size costs a reward of 1 per second.
# The penalty is 0.15/s for a vertical speed of 0.1 sqrt(g h) or a tilt rate of 0.1 sqrt(g / h), with robot height h.
_COST = 0.15
_TILT = 0.03  # By default, the reset event tilts the robot randomly by at most 0.03 rad.
_DIP = 0.003  # A random start tilt may put a wheel into the ground by at most 0.3 % of the robot's size.
_STD = 0.5  # m/s and rad/s, largest
_LEG_SCALE = (0.05, 0.25)  # An action of 1 rotates a leg joint by 0.05 to 0.25 rad.
_WHEEL_EFFORT = 0.25  # At standstill, a wheel action of 1 needs 25 % of the wheel's effort limit.


def config_files(name: str, robot: Survey) -> dict[str, str]:
    """Return the YAML texts of a task and its reward, action, observation, and termination terms, by config path."""
    files = {f"task/{name}.yaml": task_yaml(name, robot), f"reward/{name}_upright.yaml": _upright(name, robot)}
    if robot.legs:
        files[f"action/{name}_legs.yaml"] = f"""# Legs: position targets around the default pose.
{name}_legs:
  _target_: wheelleg_exp.mdp.actions.JointPositionAction
  joint_names: ${{env.robot.joint_sets.leg_actions}}
  scale: {number(_leg_scale(robot), 2)}    # rad per unit of action
  use_default_offset: true
"""
        endless = [joint for joint in robot.legs if robot.dofs[joint].range is None]
        clip = f"  clip: [-3.15, 3.15]    # rad: {endless[0]} has no limits\n" if endless else ""
        note = "Leg joints relative to their defaults, rad; a wheel's angle is unbounded and not useful for balance."
        files[f"observation/{name}_leg_pos.yaml"] = f"""# {note}
{name}_leg_pos:
  _target_: wheelleg_exp.mdp.observations.joint_pos_rel
  asset_cfg:
    {_ENTITY}
    name: robot
    joint_names: ${{env.robot.joint_sets.legs}}
{clip}"""
    if robot.wheels:
        files[f"action/{name}_wheels.yaml"] = f"""# Wheels: velocity targets.
{name}_wheels:
  _target_: wheelleg_exp.mdp.actions.JointVelocityAction
  joint_names: ${{env.robot.joint_sets.wheel_actions}}
  scale: {number(at_most(_wheel_scale(robot), 2))}    # rad/s per unit of action
"""
    if robot.raised_bodies:
        files[f"termination/{name}_contact.yaml"] = f"""# A link that should not touch the ground touches something.
{name}_contact:
  _target_: wheelleg_exp.mdp.terminations.illegal_contact
  threshold: {_threshold(robot)}    # N, of a weight of {robot.facts.weight:.3g} N
  sensor_cfg:
    {_ENTITY}
    name: contact_forces
    body_names: {names(robot.raised_bodies, 6, 16)}
"""
    return files


def task_yaml(name: str, robot: Survey) -> str:
    """Return the text of ``task/<name>.yaml``, in which the robot learns to stand and stay in place."""
    legs, wheels = bool(robot.legs), bool(robot.wheels)
    actions = _chosen((f"{name}_legs", legs), (f"{name}_wheels", wheels))
    seen = _chosen(
        "base_ang_vel, projected_gravity, velocity_commands", (f"{name}_leg_pos", legs), "joint_vel_rel, last_action"
    )
    rewards = _chosen(
        f"alive, terminating, {name}_upright, base_height",
        ("lin_vel_z, ang_vel_xy, track_lin_vel_xy, track_ang_vel_z", robot.level),
        ("leg_joint_deviation", legs),
        "action_rate",
        ("wheel_air", wheels),
    )
    ends = _chosen(
        "time_out", (f"{name}_contact", bool(robot.raised_bodies)), ("bad_orientation", robot.level), "non_finite_state"
    )
    limit = "  terminations:\n    bad_orientation: {limit_angle: 0.8}   # rad, of tilt from upright\n"
    ends_at = limit if robot.level else ""
    return f"""# @package _global_
# {name} learns to stand on flat ground. `wheelleg train task={name}`
defaults:
  - /robot: {name}
  - /scene: flat
  - /sim: parity
  - /command@env.commands: [base_velocity]
  - /action@env.actions: [{actions}]
  - /observation@env.observations.policy.terms:
      [{seen}]
  - /observation@env.observations.critic.terms:
      [{seen}, base_lin_vel, joint_effort]
  - /event@env.events: [physics_material, add_base_mass, base_external_force_torque, reset_base, reset_robot_joints]
  - /reward@env.rewards:
      [{rewards}]
  - /termination@env.terminations: [{ends}]
  - _self_

task:
  name: {name}    # names the folder below run.root

env:
  num_envs: 512            # environments simulated side by side
  episode_length_s: 5.0    # 250 control steps
  decimation: 4            # physics steps per control step: 50 Hz control
  sim:
    dt: 0.005              # s
  commands:
    base_velocity:         # standing: the command is always zero
      ranges: {{lin_vel_x: [0.0, 0.0], lin_vel_y: [0.0, 0.0], ang_vel_z: [0.0, 0.0]}}
  observations:
    policy:
      concatenate_terms: true
      enable_corruption: false   # noise of the terms is off
      history_length: 1          # the present state is enough: nothing is noisy or delayed
      flatten_history_dim: true
    critic: {{concatenate_terms: true, enable_corruption: false, history_length: 1, flatten_history_dim: true}}
{_events(robot)}{_rewards(robot)}{ends_at}  scene:
    sensors:
      contact_forces: {{force_threshold: {_threshold(robot)}}}   # N

agent: {{max_iterations: 200}}   # about eight minutes on two cores; most robots stand after 110

check:
  silence:   # findings of `wheelleg check --physics` that this task accepts, each with its reason
    zero_width_range: joints start at their defaults, MuJoCo has no restitution, and the command of standing is zero
"""


def _chosen(*parts: str | tuple[str, bool]) -> str:
    return ", ".join(part if isinstance(part, str) else part[0] for part in parts if isinstance(part, str) or part[1])


def _threshold(robot: Survey) -> str:
    return number(_CONTACT * robot.facts.weight, 2)


def _events(robot: Survey) -> str:
    weight = robot.facts.weight
    low, high = (number(share * robot.trunk_mass, 2) for share in _LOAD)
    force, torque = number(_FORCE * weight, 2), number(_TORQUE * weight * robot.size, 2)
    # Reduce the reset event's random tilt if its default range would put a wheel or foot into the ground.
    anatomy = robot.anatomy
    # Without wheels, assume that each foot is half of the robot's size away from the robot's middle.
    arms = dict.fromkeys(("roll", "pitch"), anatomy.size / 2)
    if anatomy.forward is not None:
        along = [sum(a * b for a, b in zip(wheel.contact, anatomy.forward, strict=True)) for wheel in anatomy.standing]
        arms = {"roll": anatomy.support_width / 2, "pitch": max(map(abs, along), default=0.0)}
    dip = _DIP * anatomy.size
    most = {axis: math.floor(1e3 * dip / arm) / 1e3 for axis, arm in arms.items() if arm * _TILT > dip}
    ranges = ", ".join(f"{axis}: [-{tilt}, {tilt}]" for axis, tilt in most.items())
    tilts = f"    reset_base: {{pose_range: {{{ranges}}}}}    # rad: more puts a wheel or foot into the ground\n"
    return f"""  events:                  # the stock disturbances, sized for {robot.facts.mass:.3g} kg
    add_base_mass: {{mass_distribution_params: [{low}, {high}]}}    # kg
    base_external_force_torque:
      force_range: [-{force}, {force}]          # N
      torque_range: [-{torque}, {torque}]       # N·m
    physics_material: {{restitution_range: [0.0, 0.0]}}    # MuJoCo has none
    reset_robot_joints: {{velocity_range: [1.0, 1.0]}}     # a factor on defaults of 0
{tilts if ranges else ""}"""


def _rewards(robot: Survey) -> str:
    size = robot.size
    text = f"""  rewards:                 # per second, sized for a robot that is {size:.3g} m high
    base_height: {{weight: {number(-1.0 / (_ERROR * size) ** 2, 2)}}}    # an error of a fifth of the height costs 1/s
    action_rate: {{weight: {number(-0.4 / max(1, len(robot.legs) + len(robot.wheels)), 2)}}}
"""
    if robot.level:
        gravity, size, track = robot.facts.gravity, robot.size, robot.facts.track
        turning = min(_STD, 2 * _tolerance(robot) / track) if track else _STD
        text += f"""    lin_vel_z: {{weight: {number(-_COST / (0.01 * gravity * size), 2)}}}
    ang_vel_xy: {{weight: {number(-_COST * size / (0.01 * gravity), 2)}}}
    track_lin_vel_xy: {{weight: 2.0, std: {number(_tolerance(robot), 2)}}}   # m/s
    track_ang_vel_z: {{weight: 1.0, std: {number(turning, 2)}}}   # rad/s
"""
    if robot.legs:
        text += "    leg_joint_deviation: {weight: -0.5}\n"
    if robot.wheels:
        text += f"    wheel_air: {{threshold: {_threshold(robot)}}}    # N\n"
    return text


def _tolerance(robot: Survey) -> float:
    """Return a drift speed that a standing robot should avoid, m/s: the speed at a wheel action of 1."""
    return min(_STD, _wheel_scale(robot) * robot.facts.wheel_radius) if robot.wheels else _STD


def _wheel_scale(robot: Survey) -> float:
    """Return the wheel speed (rad/s) for an action of 1, which needs 25 % of the effort limit at standstill."""
    gains = wheel_gains(robot)
    wanted = {name: _WHEEL_EFFORT * gains.effort[name] / gains.damping[name] for name in gains.velocity}
    return min(min(max(wanted[name], 0.1 * top), top) for name, top in gains.velocity.items())


def _leg_scale(robot: Survey) -> float:
    """Return the leg rotation for an action of 1, rad, within the torque and joint limits if possible."""
    gains, reach = leg_gains(robot), []
    for name in robot.legs:
        low, high = robot.dofs[name].range or (-math.inf, math.inf)
        reach += [robot.positions[name] - low, high - robot.positions[name], gains.effort[name] / gains.stiffness[name]]
    smallest, largest = _LEG_SCALE
    return min(largest, max(smallest, math.floor(100 * min(reach)) / 100 if min(reach) < largest else largest))


def _upright(name: str, robot: Survey) -> str:
    return f"""# Standing upright: this project's own term, in {name}/terms.py.
{name}_upright:
  _target_: {name}.terms.upright
  weight: 2.0
  std: 0.2    # rad, tilt that leaves 1/e of the reward
  up: [{", ".join(number(part) for part in robot.up)}]    # the root link's axis that should point up
"""
