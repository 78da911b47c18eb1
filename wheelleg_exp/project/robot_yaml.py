"""Write the robot YAML file of a project from measurements of the robot."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from wheelleg_exp.anatomy.compiled_robot import name_expression
from wheelleg_exp.asset.robot_description import Dof
from wheelleg_exp.lint.rule import at_least, at_most
from wheelleg_exp.lint.rules_drives import MOST_DAMPING
from wheelleg_exp.project.survey import Survey, joint_pairs

WIDTH = 110
_PLAIN = re.compile(r"[A-Za-z_][\w./-]*")
_WORDS = {"null", "true", "false", "yes", "no", "on", "off", "y", "n"}
_LEG_RATE = 2 * math.pi * 3  # The default bandwidth of a leg joint is 3 Hz.
_DAMPING_RATIO = 0.7
_SAG = 0.05  # The default stiffness of a leg joint limits the position error under the robot's weight to 0.05 rad.
_STRENGTH = 3.0  # The default effort limit of a leg joint is three times the torque that carries the robot's weight.
_LEVER = 0.25  # The lever of the robot's weight at a leg joint is assumed to be at least 25 % of the leg's length.
_BENDS = 0.35  # A stiffness is too small if the robot's weight causes a position error above 0.35 rad.
# A stiffness is too large if a position error of 0.05 rad needs more than four times the drive's effort limit.
_FULL = 4.0
_SLIPS = 5.0  # A wheel's effort limit above five times the torque at which the wheel slips is not realistic.
_FAST = 100.0  # A joint's speed limit above 100 rad/s is not realistic.
_WEAK = 0.3  # A leg drive's effort limit must be at least 30 % of the torque that carries the robot's weight.
_STEP = 0.005  # A new project's task has a physics time step of at most 5 ms.
_LEG_SPEED = 15.0  # rad/s
_WHEEL_TIME = 0.1  # A wheel's default damping gives its speed a time constant of 0.1 s.
_TRACTION = 1.5  # The default effort limit of a wheel is 1.5 times the torque at which the wheel slips.
_GROUND_SPEED = 2.0  # m/s
_LEG_SCALE = (0.05, 0.25)  # An action of 1 rotates a leg joint by 0.05 to 0.25 rad.
_WHEEL_EFFORT = 0.25  # At standstill, a wheel action of 1 needs 25 % of the wheel's effort limit.
_STEPS_PER_FALL = 5.0  # control steps in the time constant with which the robot falls
_SLOWEST = 4  # physics steps of 5 ms per control step at most: 50 Hz control
_TILT = 0.03  # The start states of stock tasks tilt the robot by at most 0.03 rad.
_ENDLESS = 1e6  # An effort or speed limit above 1e6 in a robot file means that the joint is unlimited.


@dataclass(frozen=True)
class Gains:
    """The gains and limits of a group of actuators; dictionaries such as ``stiffness`` map joint names to values.

    Units: stiffness N·m/rad, damping N·m·s/rad, effort N·m, velocity rad/s. ``given`` names the fields whose values are
    all from the robot file. ``refused`` lists unusable values of the robot file, with the reasons.
    """

    stiffness: dict[str, float]
    damping: dict[str, float]
    effort: dict[str, float]
    velocity: dict[str, float]
    given: list[str]
    refused: list[str]


def leg_gains(robot: Survey, joints: Sequence[str] | None = None) -> Gains:
    """Return the gains of position-controlled joints, which are the leg joints by default.

    The defaults: a bandwidth of 3 Hz and a damping ratio of 0.7 under load, a position error of at most 0.05 rad under
    the weight, and three times the torque that carries the weight. A stiffness from the robot file is not used if it is
    too small for the weight, too large for the effort limit, or unstable with the physics time step.
    """
    dofs, refused, untaken = robot.dofs, list[str](), set[str]()
    held = robot.legs if joints is None else list(joints)
    loads = {name: _load(robot, name) for name in held}

    def file_stiffness(name: str) -> float | None:
        kp, effort = _stiffness(dofs[name]), _effort(dofs[name])
        reason = ""
        if kp is not None and kp * _BENDS < loads[name].holds_now:
            reason = f"makes {name} bend by more than {_BENDS} rad under the weight"
        elif kp is not None and effort is not None and kp * _SAG > _FULL * effort:
            reason = f"needs the whole effort of {name} at {effort / kp:.2g} rad"
        elif kp is not None and kp > 4 * loads[name].stiffest:
            reason = f"is unstable on {name} with steps of {_STEP} s"
        if not reason:
            return kp
        refused.append(f"a stiffness of {kp:.3g} {reason}")
        untaken.add(name)
        return None

    def file_effort(name: str) -> float | None:
        effort = _effort(dofs[name])
        if effort is not None and effort < max(loads[name].holds_now, _WEAK * loads[name].hold):
            refused.append(f"an effort of {effort:.3g} does not hold the weight at {name}")
            return None
        return effort

    wanted = {n: max(load.inertia * _LEG_RATE**2, load.hold / _SAG) for n, load in loads.items()}
    stiffness, given = _filled(robot, held, file_stiffness, lambda n: min(wanted[n], 2 * loads[n].stiffest))
    critical = {n: math.sqrt(stiffness[n] * max(load.inertia, load.carried)) for n, load in loads.items()}
    own_damping = {n: None if n in untaken else _damping(dofs[n], of_speed=False) for n in held}
    damping, own = _filled(robot, held, own_damping.__getitem__, lambda n: 2 * _DAMPING_RATIO * critical[n])
    strong = {n: max(_STRENGTH * load.hold, stiffness[n] * _SAG * _STRENGTH) for n, load in loads.items()}
    effort, limited = _filled(robot, held, file_effort, strong.__getitem__)
    velocity, fast = _filled(robot, held, lambda name: _velocity(dofs[name]), lambda _: _LEG_SPEED)
    found = {"stiffness": given, "damping": own, "effort": limited, "velocity": fast}
    return Gains(stiffness, damping, effort, velocity, [name for name, complete in found.items() if complete], refused)


@dataclass(frozen=True)
class _Load:
    """The inertias and torques from which the default gains of a leg joint are computed.

    ``inertia`` (kg·m²) is what the torque accelerates while all other joints are free. ``carried`` (kg·m²) is that of
    the carried mass, as a point at the lever of the weight. ``holds_now`` (N·m) holds the default pose; ``hold`` is the
    larger of it and the torque of the weight at a lever of a quarter of the leg's length. At the stiffness ``stiffest``
    (N·m/rad), the undamped joint oscillates at one radian per physics step.
    """

    inertia: float
    carried: float
    holds_now: float
    hold: float
    stiffest: float


def _load(robot: Survey, name: str) -> _Load:
    joint, share = robot.facts.joints[name], 1 / max(1, len(robot.wheels))
    weight = robot.facts.weight * share
    on_chain = any(name in leg.joints for leg in robot.anatomy.legs) or not robot.wheels
    least = _LEVER * max(0.0, robot.size - robot.facts.wheel_radius) * weight if on_chain else 0.0
    hold = max(abs(joint.hold), least)
    lever = hold / weight if weight > 0 else 0.0
    carried = robot.facts.mass * share * lever**2
    return _Load(joint.effective, carried, abs(joint.hold), hold, joint.effective / _STEP**2)


def wheel_gains(robot: Survey) -> Gains:
    """Return the gains of the wheels; the stiffness is 0, because wheels follow speed targets.

    The default damping gives the wheel's speed a time constant of 0.1 s. The default effort limit is 1.5 times the
    torque at which the wheel slips, and the default velocity limit is 2 m/s on the ground.
    """
    facts, count = robot.facts, max(1, len(robot.wheels))
    share = facts.mass / count * robot.facts.wheel_radius**2

    dofs, refused = robot.dofs, list[str]()
    started = {name: (facts.joints[name].effective + share) / _WHEEL_TIME for name in robot.wheels}
    damping, own = _filled(robot, robot.wheels, lambda n: _damping(dofs[n], of_speed=True), started.__getitem__)
    # ``slips`` is the torque at which a wheel slips, N·m.
    slips = max(facts.friction, 0.5) * facts.weight / count * robot.facts.wheel_radius

    def file_effort(name: str) -> float | None:
        effort = _effort(dofs[name])
        if effort is not None and effort > _SLIPS * slips and robot.standing is not None:
            refused.append(f"an effort of {effort:.3g} at {name}, which slips at {slips:.2g}")
            return None
        return effort

    effort, limited = _filled(robot, robot.wheels, file_effort, lambda _: _TRACTION * slips)
    velocity, fast = _filled(
        robot, robot.wheels, lambda n: _velocity(dofs[n]), lambda _: _GROUND_SPEED / robot.facts.wheel_radius
    )
    found = {"damping": own, "effort": limited, "velocity": fast}
    none = dict.fromkeys(robot.wheels, 0.0)
    return Gains(none, damping, effort, velocity, [name for name, complete in found.items() if complete], refused)


def _filled(
    robot: Survey, joints: list[str], from_file: Callable[[str], float | None], default: Callable[[str], float]
) -> tuple[dict[str, float], bool]:
    """Return the value of one gain or limit for each joint, and whether the robot file gives all of these values."""
    found = {name: from_file(name) for name in joints}
    values = {name: value if value is not None else at_least(default(name)) for name, value in found.items()}
    for pair in robot.anatomy.mirrored:
        if pair.left in values and pair.right in values and found[pair.left] is None and found[pair.right] is None:
            values[pair.left] = values[pair.right] = max(values[pair.left], values[pair.right])
    return values, bool(joints) and all(value is not None for value in found.values())


def _stiffness(dof: Dof) -> float | None:
    return dof.drive.stiffness if dof.drive is not None and dof.drive.stiffness > 0 else None


def _damping(dof: Dof, *, of_speed: bool) -> float | None:
    """Return the damping of a position drive, or of a velocity drive, which is the gain of its speed error."""
    drive = dof.drive
    is_wanted = drive is not None and (drive.stiffness == 0) == of_speed and drive.damping > 0
    return drive.damping if drive is not None and is_wanted else None


def _effort(dof: Dof) -> float | None:
    limits = [dof.drive.effort] if dof.drive is not None else []
    limits += [max(map(abs, dof.force_range))] if dof.force_range is not None else []
    return min((limit for limit in limits if limit is not None and 0 < limit < _ENDLESS), default=None)


def _velocity(dof: Dof) -> float | None:
    limit = dof.max_velocity
    return limit if limit is not None and 0 < limit < _FAST else None


_TOUCH = "whether the robot's own bodies can touch; null means as in the asset"
_HEIGHT_STEP = 1e-4  # A robot's start height is rounded up to 0.1 mm, so that no part starts inside the ground.


def robot_yaml(name: str, asset: str, robot: Survey) -> str:
    """Return the text of ``robot/<name>.yaml``; ``asset`` is the robot file's path in the asset folder."""
    facts = robot.facts
    rotation = ", ".join(number(part, 6) for part in robot.rotation)
    moved = {joint: value for joint, value in robot.positions.items() if value != 0.0}
    size = f" of {1e3 * robot.facts.wheel_radius:.3g} mm radius" if robot.wheels else ""
    held = f"; {_counted(len(robot.held), 'other joint')} held still" if robot.held else ""
    as_in_file = ", as the file has it" if robot.standing is None or robot.standing.frame is None else ""
    stance = robot.standing.stance if robot.standing is not None else None
    note, kept = "", "  # rad; all joints are 0"
    if stance is not None:
        share = round(100 * stance.height / stance.tallest) if stance.tallest > 0 else 0
        balanced = ", the mass over the axle" if stance.balanced and robot.anatomy.one_axle else ""
        note = f": {share} % of the largest height{balanced}"
    if moved:
        limited = ((name, dof.range) for name, dof in robot.dofs.items() if dof.range is not None)
        at_zero = ", ".join(name for name, (low, high) in limited if not low <= 0.0 <= high)
        outside = f"; 0 is outside the limits of {at_zero}" if at_zero else ""
        kept = f"  # rad (m for a slide){note}; other joints are 0{outside}"
    pairs = [pair for pair in robot.anatomy.mirrored if pair.left in robot.legs and pair.right in robot.legs]
    alike = [pair for pair in pairs if pair.sign > 0]
    # Stock terms refer to these keys, such as ``${env.robot.joint_sets.legs}``.
    joints = {
        "legs": robot.legs,
        "wheels": robot.wheels,
        "left_legs": [pair.left for pair in alike],
        "right_legs": [pair.right for pair in alike],
        "leg_actions": robot.legs,
        "wheel_actions": robot.wheels,
    }
    legs = [name for name in robot.raised_bodies if name != robot.trunk]
    bodies = {"base": [robot.trunk], "legs": legs, "wheels": robot.wheel_bodies}
    groups = ""
    if robot.legs:
        groups += _group("legs", robot.legs, leg_gains(robot))
    if robot.held:
        groups += _group("held", robot.held, leg_gains(robot, robot.held))
    if robot.wheels:
        groups += _group("wheels", robot.wheels, wheel_gains(robot))
    scales = ", ".join(f"{role}: {scale}" for role, scale in _action_scales(robot).items())
    control_dt, physics_steps = _STEP * _decimation(robot), _physics_steps(robot)
    return f"""# @package env.robot
# {facts.mass:.4g} kg, {_counted(len(robot.legs), "leg joint")} and {_counted(len(robot.wheels), "wheel")}{size}{held}.
profile: {name}    # name in results
asset: {word(asset)}    # below this project's assets/
base: floating                     # auto | floating | fixed
init_state:
  pos: [0.0, 0.0, {spawn_height(robot)!r}]    # root link, m: a tilted start touches nothing
  rot: [{rotation}]    # (w, x, y, z){as_in_file}
{kept}
  joint_pos:{mapping(moved, 4)}
  joint_vel: {{".*": 0.0}}         # rad/s
joint_order: null                  # breadth first, as in PhysX; or a list of all joints
soft_joint_pos_limit_factor: 0.95  # soft limits, as share of the joint range
friction_source: static            # static | dynamic: source of MuJoCo's single coefficient
standing_height: {number(facts.standing_height)}    # m, of the root link in the default pose
wheel_radius: {number(robot.facts.wheel_radius) if robot.wheels else "null"}    # m
size: {number(robot.size)}    # m; height of the root link or of the centre of mass, whichever is larger
mass: {number(facts.mass)}    # kg
natural_speed: {number(natural_speed(robot))}    # m/s; sqrt(gravity · size), at most the wheels' top speed
leg_reach: {number(_leg_reach(robot), 3) if robot.legs else "null"}    # rad; rotation that drives and limits allow
physics_dt: {number(control_dt / physics_steps, 17)}    # s
decimation: {physics_steps}    # physics steps per control step: {1 / control_dt:.0f} Hz control
action_scales: {{{scales}}}    # rad and rad/s per unit of action
{_joint_pairs(robot)}joint_sets:    # joints by role, to which terms refer; left_legs, right_legs: pairs that turn alike
{_named_lists(joints)}body_sets:     # links by role; legs: the links, except the base, that do not touch the ground
{_named_lists(bodies)}{_frame(robot)}{_self_collisions(robot)}actuators:
{groups}"""


def spawn_height(robot: Survey) -> float:
    """Return a height of the root link, m, at which the robot touches nothing at the largest tilt of a start state."""
    anatomy = robot.anatomy
    arms = [anatomy.size / 2]  # Without wheels, assume that each foot is half of the robot's size from its middle.
    if anatomy.forward is not None:
        along = [sum(a * b for a, b in zip(wheel.contact, anatomy.forward, strict=True)) for wheel in anatomy.standing]
        arms = [anatomy.support_width / 2, max(map(abs, along), default=0.0)]
    height = robot.facts.standing_height + _TILT * sum(arms)
    return round(math.ceil(height / _HEIGHT_STEP - 1e-6) * _HEIGHT_STEP, 6)


def natural_speed(robot: Survey) -> float:
    """Return √(gravity · size), but at most the top speed of the wheels, m/s."""
    top = min((speed for speed in wheel_gains(robot).velocity.values()), default=math.inf) * robot.facts.wheel_radius
    return min(math.sqrt(robot.facts.gravity * robot.size), top or math.inf)


def _decimation(robot: Survey) -> int:
    """Return the number of physics steps of 5 ms per control step."""
    balance = robot.facts.balance
    steps = 1.0 / (_STEPS_PER_FALL * balance.pole * _STEP) if balance is not None else _SLOWEST
    return max(1, min(_SLOWEST, int(steps)))


def _physics_steps(robot: Survey) -> int:
    """Return the number of physics steps per control step: short ones if drives damp the legs strongly."""
    damping, joints = leg_gains(robot).damping, robot.facts.joints
    worst = max((_STEP * damping[name] / joints[name].effective for name in damping), default=0.0)
    return math.ceil(_decimation(robot) * max(1.0, worst / MOST_DAMPING) - 1e-9)


def _action_scales(robot: Survey) -> dict[str, float]:
    scales = {"legs": _leg_scale(robot)} if robot.legs else {}
    return scales | ({"wheels": at_most(_wheel_scale(robot), 2)} if robot.wheels else {})


def _wheel_scale(robot: Survey) -> float:
    """Return the wheel speed (rad/s) for an action of 1, which needs 25 % of the effort limit at standstill."""
    gains = wheel_gains(robot)
    wanted = {name: _WHEEL_EFFORT * gains.effort[name] / gains.damping[name] for name in gains.velocity}
    return min(min(max(wanted[name], 0.1 * top), top) for name, top in gains.velocity.items())


def _leg_scale(robot: Survey) -> float:
    """Return the leg rotation for an action of 1, rad, within the torque and joint limits if possible."""
    smallest, largest = _LEG_SCALE
    reach = _leg_reach(robot)
    return min(largest, max(smallest, math.floor(100 * reach) / 100 if reach < largest else largest))


def _leg_reach(robot: Survey) -> float:
    """Return the rotation that the drives and the limits of all leg joints allow around the default pose, rad."""
    gains, reach = leg_gains(robot), []
    for name in robot.legs:
        low, high = robot.dofs[name].range or (-math.inf, math.inf)
        reach += [robot.positions[name] - low, high - robot.positions[name], gains.effort[name] / gains.stiffness[name]]
    return max(min(reach), _LEG_SCALE[0])


def _joint_pairs(robot: Survey) -> str:
    if robot.asymmetry is not None:
        return f"joint_pairs: null    # not symmetric: {robot.asymmetry}\n"
    items = "".join(f"\n  {word(left)}: {word(str(right))}" for left, right in joint_pairs(robot.anatomy).items())
    return f"joint_pairs:{items or ' {}'}    # joints of one side, and their mirror images\n"


def _named_lists(lists: Mapping[str, Sequence[str]]) -> str:
    return "".join(f"  {role}: {names(members, 4, len(role) + 4)}\n" for role, members in lists.items())


def _frame(robot: Survey) -> str:
    standing = robot.standing
    if standing is None or standing.frame is None:
        return ""
    why = "which does not have x forwards and z upwards"
    if standing.lean != 0.0:
        why = f"which leans by {math.degrees(standing.lean):.2g} degrees, so that the mass is over the axle"
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


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _group(name: str, joints: list[str], gains: Gains) -> str:
    quantities = " and ".join(filter(None, [", ".join(gains.given[:-1]), *gains.given[-1:]]))
    source = f"{quantities} from the robot's file" if quantities else ""
    rest = "" if len(gains.given) == (3 if name == "wheels" else 4) else "defaults from masses and inertias: check them"
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
    # rad/s; targets are clipped to this limit
    velocity_limit:{by_joint(gains.velocity, 6)}
    # kg·m², of the motors' rotors; null means as in the file
    armature: null
"""


def number(value: float, digits: int = 4) -> str:
    """Return a number as text with few significant digits, which YAML reads as a float."""
    if not math.isfinite(value):
        raise ValueError(f"a measurement of the robot gave {value} instead of a finite number")
    text = repr(float(f"{value:.{digits}g}"))
    return text if "." in text else text.replace("e", ".0e")


def word(name: str) -> str:
    """Return a text as a YAML scalar, with quotes if YAML needs quotes."""
    plain = _PLAIN.fullmatch(name) and name.lower() not in _WORDS
    return name if plain else json.dumps(name, ensure_ascii=False)


def names(values: Sequence[str], indent: int, used: int = 0) -> str:
    """Return names as a YAML list, which starts after ``used`` characters; further lines have ``indent`` spaces."""
    items = [word(name_expression(value)) for value in values]
    line = "[" + ", ".join(items) + "]"
    if used + len(line) <= WIDTH:
        return line
    lines, current = [], ""
    for item in items:
        if current and indent + len(current) + len(item) + 3 > WIDTH:
            lines.append(current)
            current = ""
        current += ("" if not current else " ") + item + ","
    lines.append(current.rstrip(","))
    space = "\n" + " " * indent
    return "[" + space + space.join(lines) + "]"


def by_joint(values: Mapping[str, float], indent: int) -> str:
    """Return the text after a key: one number for all joints, or one line per joint."""
    if len({number(value) for value in values.values()}) <= 1:
        return f" {number(next(iter(values.values()), 0.0))}"
    return mapping(values, indent)


def mapping(values: Mapping[str, float], indent: int) -> str:
    """Return the text after a key: one line per name, or an empty mapping."""
    if not values:
        return " {}"
    space = "\n" + " " * indent
    return "".join(f"{space}{word(name_expression(name))}: {number(value)}" for name, value in values.items())
