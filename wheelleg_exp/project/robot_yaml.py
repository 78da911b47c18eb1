"""Writes a project's robot YAML from what was measured."""

from __future__ import annotations

import math

from wheelleg_exp.project.gains import Gains, leg_gains, wheel_gains
from wheelleg_exp.project.survey import Survey
from wheelleg_exp.project.yaml_text import by_joint, mapping, names, number, word

_TOUCH = "whether the robot's own bodies may touch; null is what the asset says"
_STEP = 1e-4  # m to which the height is rounded, upwards: nothing begins inside the ground


def robot_yaml(name: str, asset: str, robot: Survey) -> str:
    """Return ``robot/<name>.yaml``.

    Args:
        name: the project's name.
        asset: the robot's file, relative to the project's assets.
        robot: its survey.
    """
    facts = robot.facts
    rotation = ", ".join(number(part, 6) for part in robot.rotation)
    moved = {joint: value for joint, value in robot.positions.items() if value != 0.0}
    kept = (
        f"  # rad (m for a slide){_pose_note(robot)}; other joints are 0{_limits(robot)}"
        if moved
        else "  # rad; all joints are 0"
    )
    return f"""# @package env.robot
# {facts.mass:.4g} kg, {_counted(len(robot.legs), "leg joint")} and {_wheels(robot)}{_held(robot)}.
profile: {name}    # the name that results carry
asset: {word(asset)}    # below this project's assets/
base: floating                     # auto | floating | fixed
init_state:
  pos: [0.0, 0.0, {spawn_height(robot)!r}]    # root link, m: the lowest collider of the default pose touches the ground
  rot: [{rotation}]    # (w, x, y, z){_rotation_note(robot)}
{kept}
  joint_pos:{mapping(moved, 4)}
  joint_vel: {{".*": 0.0}}         # rad/s
joint_order: null                  # breadth first, as PhysX parses it; or a list of all joints
soft_joint_pos_limit_factor: 0.95  # share of the joint range that soft limits keep
friction_source: static            # static | dynamic: which coefficient MuJoCo's single one is
{_frame(robot)}{_self_collisions(robot)}actuators:
{_groups(robot)}"""


def spawn_height(robot: Survey) -> float:
    """Return the height of the root link at which the lowest collider touches the ground, m, rounded upwards."""
    return round(math.ceil(robot.facts.standing_height / _STEP - 1e-6) * _STEP, 6)


def _frame(robot: Survey) -> str:
    standing = robot.standing
    if standing is None or standing.frame is None:
        return ""
    why = "which has not x forwards and z upwards"
    if standing.lean != 0.0:
        why = f"which leans by {math.degrees(standing.lean):.2g} degrees to have the mass over the axle"
    return f"""# (w, x, y, z) of the root link's frame in the file's own, {why}.
root_frame: [{", ".join(number(part, 6) for part in standing.frame)}]
"""


def _self_collisions(robot: Survey) -> str:
    if not robot.overlaps:
        return f"self_collisions: null              # {_TOUCH}\n"
    (one, other), depth = next(iter(robot.overlaps.items()))
    more = f", and {len(robot.overlaps) - 1} more pairs do" if len(robot.overlaps) > 1 else ""
    overlap = f"{1e3 * depth:.3g} mm"
    return f"""# {one} and {other} overlap by {overlap} in the default pose{more}: they would push each other.
self_collisions: false             # {_TOUCH}
"""


def _rotation_note(robot: Survey) -> str:
    return ", as the file has it" if robot.standing is None or robot.standing.frame is None else ""


def _pose_note(robot: Survey) -> str:
    stance = robot.standing.stance if robot.standing is not None else None
    if stance is None:
        return ""
    share = round(100 * stance.height / stance.tallest) if stance.tallest > 0 else 0
    balanced = ", the mass over the axle" if stance.balanced and robot.anatomy.one_axle else ""
    return f": {share} % of the largest height{balanced}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _wheels(robot: Survey) -> str:
    size = f" of {1e3 * robot.radius:.3g} mm radius" if robot.wheels else ""
    return _counted(len(robot.wheels), "wheel") + size


def _held(robot: Survey) -> str:
    return f"; {_counted(len(robot.held), 'other joint')} held still" if robot.held else ""


def _limits(robot: Survey) -> str:
    at_zero = [n for n, dof in robot.dofs.items() if dof.range is not None and not dof.range[0] <= 0.0 <= dof.range[1]]
    return "; 0 is outside the limits of " + ", ".join(at_zero) if at_zero else ""


def _groups(robot: Survey) -> str:
    groups = ""
    if robot.legs:
        groups += _group("legs", robot.legs, leg_gains(robot))
    if robot.held:
        groups += _group("held", robot.held, leg_gains(robot, robot.held))
    if robot.wheels:
        groups += _group("wheels", robot.wheels, wheel_gains(robot))
    return groups


def _group(name: str, joints: list[str], gains: Gains) -> str:
    said = " and ".join(filter(None, [", ".join(gains.given[:-1]), *gains.given[-1:]]))
    source = f"{said} as the robot's file gives {'it' if len(gains.given) == 1 else 'them'}" if said else ""
    rest = (
        "" if len(gains.given) == (3 if name == "wheels" else 4) else "modest, from masses and inertias: look at them"
    )
    refused = "".join(f"\n    # not taken: {reason}" for reason in gains.refused)
    return f"""  {name}:
    # {"; others ".join(filter(None, [source, rest])) if source else rest}{refused}
    _target_: wheelleg_exp.sim.actuators.ImplicitActuator
    joint_names_expr: {names(joints, 6, 22)}
    # N·m/rad
    stiffness:{by_joint(gains.stiffness, 6)}
    # N·m·s/rad
    damping:{by_joint(gains.damping, 6)}
    # N·m
    effort_limit:{by_joint(gains.effort, 6)}
    # rad/s; targets are clipped to it
    velocity_limit:{by_joint(gains.velocity, 6)}
    # kg·m², of the motors' rotors; null is what the file says
    armature: null
"""
