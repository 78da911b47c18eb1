"""Rules about an episode: randomisation without effect, size of pushes and wrenches, how it starts, and how it ends."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np
import torch

from wheelleg_exp.anatomy.collider_shapes import lowest_point
from wheelleg_exp.anatomy.compiled_robot import CompiledRobot
from wheelleg_exp.asset.mjcf.coupled_positions import JointCouplings
from wheelleg_exp.lint.reward_tolerances import HEIGHTS
from wheelleg_exp.lint.rule import Case, Finding, above, at_least, at_most, below, largest, rule
from wheelleg_exp.lint.rules_drives import wheel_friction
from wheelleg_exp.managers.manager_base import build

_WORLD_HEIGHTS = ("terminations.root_height_below_minimum", "rewards.base_height_l2", "observations.base_pos_z")
_REPEATED = ("reset", "interval")
# The ranges ``resampling_time_range`` and ``restitution_range`` may have equal lower and upper bounds.
_FIXED = ("resampling_time_range", "restitution_range")


@rule
def noop_joint_reset(case: Case) -> Iterator[Finding]:
    """A reset event has no effect, because it multiplies a default joint position or velocity of 0 by a factor.

    Source: Isaac Lab 2.3.2, ``isaaclab/envs/mdp/events.py``, ``reset_joints_by_scale``.
    """
    for term in case.terms("events", "events.reset_joints_by_scale"):
        joints = case.joints(term.node)
        for name, zeros in (
            ("position_range", [j for j, facts in joints.items() if facts.default == 0.0]),
            ("velocity_range", [j for j, facts in joints.items() if facts.default_velocity == 0.0]),
        ):
            low, high = term.node[name]
            if low == high or not zeros:
                continue
            what = name.removesuffix("_range")
            which = "every joint" if len(zeros) == len(joints) else ", ".join(zeros)
            yield Finding(
                f"{term.path}.{name}",
                f"the factor U({low:g}, {high:g}) multiplies a default {what} of 0 on {which}, so it has no effect",
                "reset_joints_by_offset adds the random value instead",
                {"low": low, "high": high, "joints": len(zeros)},
            )


@rule
def zero_width_range(case: Case) -> Iterator[Finding]:
    """The two ends of a random range are equal, so all random values are equal.

    Of several axes, at least one range must vary. A policy learns nothing from a constant command. Source: arithmetic.
    """
    for term in (*case.terms("events"), *case.terms("commands")):
        for name, value in term.node.items():
            ranged, pairs = name.endswith("_range"), []
            if name == "ranges" or (ranged and isinstance(value, Mapping)):
                pairs = [pair for pair in value.values() if pair is not None]
            elif (ranged or name == "mass_distribution_params") and isinstance(value, list) and len(value) == 2:
                pairs = [value]
            if not pairs or name in _FIXED or any(pair[0] != pair[1] for pair in pairs):
                continue
            low, high = float(pairs[0][0]), float(pairs[0][1])
            message, hint = f"every draw is {low:g}: the range has no width", "a range with a width, or no random value"
            yield Finding(f"{term.path}.{name}", message, hint, {"low": low, "high": high})


@rule
def event_never_fires(case: Case) -> Iterator[Finding]:
    """An event of mode ``interval`` never happens, because its interval is longer than an episode.

    Every reset draws a new interval for the event, so an interval that is longer than an episode never ends. Source:
    Isaac Lab 2.3.2, ``isaaclab/managers/event_manager.py``, ``reset``.
    """
    for term in case.terms("events"):
        if term.node.get("mode") != "interval" or term.node.get("is_global_time", False):
            continue
        shortest = float(term.node["interval_range_s"][0])
        if shortest >= case.episode_s:
            key, longest = f"{term.path}.interval_range_s", float(term.node["interval_range_s"][1])
            yield Finding(
                key,
                f"the shortest interval is {shortest:g} s and an episode lasts {case.episode_s:g} s at most; timers "
                "are redrawn at each reset, so the event never happens",
                f"an interval below {case.episode_s:g} s, longer episodes, or is_global_time",
                {"shortest_s": shortest, "episode_s": case.episode_s},
                ({key: [below(case.episode_s), longest]}, {f"{term.path}.is_global_time": True}),
            )


@rule
def cumulative_randomisation(case: Case) -> Iterator[Finding]:
    """A link's centre of mass drifts away, because a repeated event adds a new random offset each time.

    After n random offsets, each uniform in ±d, the centre of mass has a standard deviation of d sqrt(n / 3). Source:
    Isaac Lab 2.3.2, ``isaaclab/envs/mdp/events.py``, ``randomize_rigid_body_com``.
    """
    for term in case.terms("events", "events.randomize_rigid_body_com_cumulative"):
        if term.node.get("mode") not in _REPEATED:
            continue
        width = max((abs(float(v)) for pair in term.node["com_range"].values() for v in pair), default=0.0)
        spread = width * (100 / 3) ** 0.5
        yield Finding(
            f"{term.path}.mode",
            f"offsets of up to {1e3 * width:.3g} mm add up at each {term.node['mode']}: after 100 of them the spread "
            f"is {1e3 * spread:.3g} mm",
            "mode: startup draws once",
            {"width_m": width, "spread_after_100_m": spread},
            ({f"{term.path}.mode": "startup"},),
        )


@rule
def noop_restitution(case: Case) -> Iterator[Finding]:
    """An event randomises the restitution of contacts, which has no effect.

    MuJoCo's soft contacts have no coefficient of restitution. Source: MuJoCo documentation, Computation, "Contact".
    """
    for term in case.terms("events", "events.randomize_rigid_body_material"):
        low, high = term.node["restitution_range"]
        if low != high:
            key = f"{term.path}.restitution_range"
            message = f"restitution U({low:g}, {high:g}) has no effect, because MuJoCo has no such coefficient"
            hint = "[0.0, 0.0], or vary the contact softness of the model"
            yield Finding(key, message, hint, {"low": low, "high": high}, ({key: [0.0, 0.0]},))


_MARGIN = 1.2  # A good policy survives pushes that are 20 % stronger than the inverted-pendulum model predicts.
_WEAK = 0.2  # A push below 20 % of the largest push that the wheels can catch is too weak to test a policy.
_LEAN = math.radians(10.0)
_PUSHES = ("events.push_by_adding_velocity", "events.set_root_velocity")


@rule
def push_size(case: Case) -> Iterator[Finding]:
    """A push event is too strong for any policy, or too weak to test a policy.

    The largest push that wheels can catch is their acceleration, limited by friction or torque, divided by the rate
    sqrt(m g h / I) of the inverted pendulum. Every robot falls after a push far above it, and a push below a fifth of
    it does not test a policy. Pushes along the robot's own y axis are not checked, because wheels cannot catch them;
    those along the world's y axis are, because a robot that has turned by 90° can roll in this direction. Source: Pratt
    et al., "Capture point: a step toward humanoid push recovery", 2006.
    """
    balance = case.facts.balance
    if balance is None:
        return
    # ``limit`` is the largest push (a change of the velocity, m/s) that the wheels can catch.
    facts = case.facts
    drives = [(joint.drive, joint) for name in facts.wheels if (joint := facts.joints[name]).drive is not None]
    spin = min((drive.effort / joint.effective for drive, joint in drives if drive is not None), default=math.inf)
    limit = min(wheel_friction(case) * facts.gravity, spin * facts.wheel_radius) / balance.pendulum
    for term in case.terms("events", *_PUSHES):
        ranges, axes = term.node["velocity_range"], "x" if term.node.get("frame") == "yaw" else "xy"
        pushes = {axis: largest(ranges.get(axis)) for axis in axes}
        push = max(pushes.values())
        if push > _MARGIN * limit or 0.0 < push < _WEAK * limit:
            much = push > limit
            weak, strong = at_least(_WEAK * limit), at_most(limit)
            verdict = "too much" if much else f"{100 * push / limit:.0f} % of the limit, which tests nothing"
            key, hint = f"{term.path}.velocity_range", f"between {weak:g} and {strong:g} m/s"
            changed = [f"{key}.{axis}" for axis, found in pushes.items() if found == push or found > limit]
            advice = tuple({name: [-size, size] for name in changed} for size in (weak, strong))
            message = f"pushes of up to {push:.2g} m/s, and the wheels catch {limit:.2g} m/s: {verdict}"
            yield Finding(key, message, hint, {"push": push, "limit": limit, "ratio": push / limit}, advice)


@rule
def wrench_size(case: Case) -> Iterator[Finding]:
    """A permanent random force or torque tilts the robot too far.

    A constant force F tilts a balancing robot by atan(F / weight); a constant torque T tilts it by asin(T / (m g h)).
    Source: statics of the inverted pendulum.
    """
    balance = case.facts.balance
    if balance is None:
        return
    for term in case.terms("events", "events.set_permanent_body_wrench"):
        force, torque = largest(term.node["force_range"]), largest(term.node["torque_range"])
        by_force = math.atan(force / case.facts.weight)
        moment = balance.mass * case.facts.gravity * balance.height
        by_torque = math.asin(min(1.0, torque / moment))
        if by_force + by_torque > _LEAN:
            most = at_most(case.facts.weight * math.tan(_LEAN / 2)), at_most(moment * math.sin(_LEAN / 2))
            yield Finding(
                term.path,
                f"{force:g} N tilts the robot by {math.degrees(by_force):.2g}° and {torque:g} N·m by "
                f"{math.degrees(by_torque):.2g}°, for the whole episode",
                f"forces within ±{most[0]:g} N and torques within ±{most[1]:g} N·m",
                {"force_lean_rad": by_force, "torque_lean_rad": by_torque},
                ({f"{term.path}.{n}_range": [-m, m] for n, m in zip(("force", "torque"), most, strict=True)},),
            )


_DROP = 0.1  # A robot may start above the ground by at most 10 % of its standing height.
_GROUND = 1e-4  # A robot may start at most 0.1 mm inside the ground, because contacts are soft.
_HEIGHT = 0.05  # A reward's target height may differ from the robot's standing height by at most 5 %.
_FALLS = 5.0  # An episode must last at least five time constants of a robot's fall.
_UPRIGHT = math.pi
_LOWEST = ("terminations.root_height_below_minimum", "terminations.root_height_over_ground_below_minimum")
# In the rewards ``feet_air_time...``, the parameter ``threshold`` is a time in seconds, not a force.
_TIMES = ("rewards.feet_air_time", "rewards.feet_air_time_positive_biped")
_ON_WHEELS = (
    "rewards.no_contact_count",
    "rewards.no_desired_contact",
    "rewards.feet_slide",
    "rewards.wheel_slip",
    "rewards.wheel_spin_in_air_l1",
)


@rule
def spawn_height(case: Case) -> Iterator[Finding]:
    """The robot starts inside the ground, or far above the ground.

    If it starts inside the ground, the contact force throws it into the air; from a height h above the ground, it lands
    at the speed sqrt(2 g h). The colliding shapes define its lowest point in the default pose. Source: kinematics.
    """
    facts = case.facts
    clearance, limit = facts.clearance, _DROP * facts.standing_height
    if not math.isfinite(clearance) or -_GROUND <= clearance <= limit:
        return
    x, y, height = map(float, case.env.robot.init_state.pos)
    right = at_least(round(height - clearance, 9), 4)
    if clearance < 0:
        text = f"the lowest point starts {-1e3 * clearance:.3g} mm inside the ground"
        figures = {"clearance_m": clearance}
    else:
        speed = math.sqrt(2 * facts.gravity * clearance)
        text = f"the robot starts {1e3 * clearance:.3g} mm above the ground and lands at {speed:.2f} m/s"
        figures = {"clearance_m": clearance, "landing_m_s": speed}
    key, hint = "env.robot.init_state.pos", f"a height of {right:g} m puts the robot on the ground"
    yield Finding(key, text, hint, figures, ({key: [x, y, right]},))


@rule
def target_height(case: Case) -> Iterator[Finding]:
    """The rewarded height differs from the robot's height in the default pose.

    To reach the rewarded height, the policy must leave the default pose, to which actions and many rewards refer.
    Source: kinematics of the default pose.
    """
    standing = case.facts.standing_height
    for term in case.terms("rewards", *HEIGHTS):
        target = float(term.node["target_height"])
        if abs(target - standing) > _HEIGHT * standing:
            key, right = f"{term.path}.target_height", at_least(standing, 3)
            message = f"{1e3 * target:.4g} mm, and the default pose stands {1e3 * standing:.4g} mm high"
            hint = f"{right:g} m, or another default pose"
            yield Finding(key, message, hint, {"target_m": target, "standing_m": standing}, ({key: right},))


@rule
def world_height(case: Case) -> Iterator[Finding]:
    """A term measures the robot's height from z = 0 of the world, and the terrain has pits.

    In a pit of depth d, a standing robot is lower by d than on flat ground. Source: geometry of the generated tiles.
    """
    terrain, depth = case.env.scene.terrain, 0.0
    found = [term for kind in _WORLD_HEIGHTS for term in case.terms(kind.partition(".")[0], kind)]
    terms = [term for term in found if term.node.get("sensor_cfg") is None]
    if terms and "sub_terrains" in terrain:
        (made := build(terrain, "env.scene.terrain")).place(1, 1.0, torch.device("cpu"), torch.Generator)
        depth = -min(float(tile.heights.min()) for tile in made.tiles)
    for term in terms if depth > _HEIGHT * abs(case.facts.standing_height) else ():
        message = f"the height counts from z = 0, and the ground of the tiles is up to {1e3 * depth:.3g} mm lower"
        hint = "root_height_over_ground_below_minimum, base_height_over_ground_l2, or base_height"
        yield Finding(term.path, message, hint, {"depth_m": depth})


@rule
def contact_threshold(case: Case) -> Iterator[Finding]:
    """The force threshold of a contact term is too large for the robot's weight.

    A force of 1 N is negligible for a robot of 50 kg, but a fifth of the weight of a robot of 0.5 kg. The threshold for
    a body's contact should be at most a tenth of the robot's weight. The threshold for a wheel's contact should be at
    most half of the wheel's load. Source: statics.
    """
    weight, load = case.facts.weight, case.facts.wheel_load
    for section in ("terminations", "rewards"):
        for term in case.terms(section):
            threshold = term.node.get("threshold")
            stock = term.kind.startswith(("rewards.", "terminations.")) and term.kind not in _TIMES
            if not isinstance(threshold, (int, float)) or not stock:
                continue
            wheels = term.kind in _ON_WHEELS
            limit = 0.5 * load if wheels else 0.1 * weight
            if threshold > limit:
                key, most = f"{term.path}.threshold", at_most(limit)
                message = f"{threshold:g} N is {100 * threshold / weight:.0f} % of the robot's weight of {weight:.3g} N"
                hint = f"at most {most:g} N"
                yield Finding(key, message, hint, {"threshold": float(threshold), "weight": weight}, ({key: most},))


@rule
def episode_end(case: Case) -> Iterator[Finding]:
    """Training episodes have no time-out, end at once, or are too short for a fall.

    Without a time-out, the critic does not bootstrap the rewards after the end of an episode. If the start state
    exceeds the limit of a termination, every episode ends in its first step. A fall with the time constant 1/p takes
    several time constants. Source: Pardo et al., "Time limits in reinforcement learning", 2018.
    """
    terms = list(case.terms("terminations"))
    if not any(term.node.get("time_out", False) for term in terms):
        message = "no termination is a time-out: the end of an episode would count as a failure, or never come"
        yield Finding("env.terminations", message, "the termination time_out, with time_out: true")
    for term in terms:
        if term.kind in _LOWEST:
            limit, start = float(term.node["minimum_height"]), case.facts.standing_height
            if limit >= start:
                key, lower = f"{term.path}.minimum_height", below(start, 3)
                message = f"the robot stands {1e3 * start:.4g} mm high, below the limit of {1e3 * limit:.4g} mm"
                hint = f"at most {lower:g} m"
                yield Finding(key, message, hint, {"limit_m": limit, "standing_m": start}, ({key: lower},))
        if term.kind == "terminations.bad_orientation":
            limit = float(term.node["limit_angle"])
            drawn = [reset.node["pose_range"] for reset in case.terms("events", "events.reset_root_state_uniform")]
            tilt = max((math.hypot(largest(r.get("roll")), largest(r.get("pitch"))) for r in drawn), default=0.0)
            if limit >= _UPRIGHT or limit <= tilt:
                key, bounds = f"{term.path}.limit_angle", (above(tilt), below(_UPRIGHT))
                why = "has no effect" if limit >= _UPRIGHT else f"is within the tilt of {tilt:.3g} rad that resets draw"
                message = f"a limit of {limit:.3g} rad {why}"
                hint = f"between {bounds[0]:g} and {bounds[1]:g} rad"
                figures = {"limit_rad": limit, "drawn_rad": tilt}
                yield Finding(key, message, hint, figures, tuple({key: bound} for bound in bounds))
    balance = case.facts.balance
    if balance is not None and case.episode_s < _FALLS / balance.pole:
        key, shortest = "env.episode_length_s", at_least(_FALLS / balance.pole)
        yield Finding(
            key,
            f"an episode of {case.episode_s:g} s holds {case.episode_s * balance.pole:.2g} time constants of the fall "
            f"({1 / balance.pole:.3g} s): it can end before the robot falls",
            f"at least {shortest:g} s",
            {"episode_s": case.episode_s, "time_constant_s": 1 / balance.pole},
            ({key: shortest},),
        )


_DEPTH = 0.01  # Soft contacts gently correct a start that is inside the ground by at most 1 % of the robot's size.


@rule
def reset_into_ground(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """A random start state can put the robot's lowest point inside the ground.

    ``reset_into_ground`` tests all combinations of the extreme start heights, rolls, pitches, and joint positions. If a
    robot starts inside the ground, the contact force throws the robot into the air. Source: kinematics.
    """
    if not robot.anatomy.floating:
        return
    joints = list(_drawn_joints(case, robot))
    for term in case.terms("events", "events.reset_root_state_uniform"):
        ranges = term.node["pose_range"]
        tilts = [tuple(ranges.get(axis) or (0.0, 0.0)) for axis in ("roll", "pitch")]
        drop = min(ranges.get("z") or (0.0, 0.0))
        poses = itertools.product(*tilts, joints)
        depth = -min(_lowest(robot, float(roll), float(pitch), pose) for roll, pitch, pose in poses) - float(drop)
        start = -case.facts.clearance  # The rule ``spawn_height`` reports if the default pose is inside the ground.
        if depth > _DEPTH * robot.anatomy.size and depth > start + _DEPTH * robot.anatomy.size:
            height = float(case.env.robot.init_state.pos[2])
            right = at_least(height + depth, 4)
            message = f"random starts reach {1e3 * depth:.3g} mm into the ground"
            hint = f"narrower ranges of z, roll and pitch, or env.robot.init_state.pos with a height of {right:g} m"
            yield Finding(f"{term.path}.pose_range", message, hint, {"depth_m": depth})


def _drawn_joints(case: Case, robot: CompiledRobot) -> Iterator[dict[str, float]]:
    yield {}
    for kind in ("scale", "offset"):
        for term in case.terms("events", f"events.reset_joints_by_{kind}"):
            for value in map(float, term.node["position_range"]):
                yield {
                    name: joint.default * value if kind == "scale" else joint.default + value
                    for name, joint in case.joints(term.node).items()
                    if name not in robot.anatomy.wheel_joints
                }


def _lowest(robot: CompiledRobot, roll: float, pitch: float, joints: Mapping[str, float]) -> float:
    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.data.qpos
    for name, value in joints.items():
        joint = model.joint(name)
        low, high = model.jnt_range[joint.id] if model.jnt_limited[joint.id] else (-np.inf, np.inf)
        data.qpos[joint.qposadr[0]] = min(max(value, low), high)
    JointCouplings(model).follow(data.qpos)
    turn, quat = np.zeros(4), np.zeros(4)
    mujoco.mju_euler2Quat(turn, np.array([roll, pitch, 0.0]), "XYZ")  # MuJoCo rotates about fixed axes for "XYZ".
    start = int(model.jnt_qposadr[model.body(robot.anatomy.base).jntadr[0]]) + 3
    mujoco.mju_mulQuat(quat, data.qpos[start : start + 4], turn)
    data.qpos[start : start + 4] = quat
    mujoco.mj_kinematics(model, data)
    return lowest_point(model, data, [model.body(name).id for name in robot.bodies])
