"""Actions and commands against what joints, drives and wheels can do."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

from wheelleg_exp.lint.case import Case, TermView, largest
from wheelleg_exp.lint.findings import Finding, at_least, at_most, rule
from wheelleg_exp.lint.robot_facts import Drive, Joint

_POSITION = ("actions.JointPositionAction", "actions.RelativeJointPositionAction")
_ABSOLUTE = "actions.JointPositionAction"
_VELOCITY = ("actions.JointVelocityAction",)
_TINY = 0.01  # share of a joint's range that one unit of action should move at least


@rule
def action_scale(case: Case) -> Iterator[Finding]:
    """An action whose unit is too large, too small, or moves nothing.

    A policy begins with actions of about ±1. One unit should stay within the joint's limits, the drive's torque
    and its speed, move at least a hundredth of the range, and meet a gain that is not 0: a position target on a
    drive without stiffness, or a speed target on one without damping, does nothing.
    Source: the drive's law, tau = kp (q* - q) + kd (qd* - qd).
    """
    for term in case.terms("actions", *_POSITION, *_VELOCITY):
        joints = case.joints(term.node)
        scales = case.by_joint(term.node.get("scale", 1.0), list(joints), 1.0)
        for name, joint in joints.items():
            if joint.drive is None:
                continue
            unit = abs(float(scales[name]))
            reason = _reason(term, joint, joint.drive, unit)
            if reason is not None:
                key, (message, hint, figures) = f"{term.path}.scale", reason
                scale = None if hint else _fitting_scale(term, joints.values(), unit)
                hint = hint or ("a default pose well inside the limits" if scale is None else f"a scale near {scale:g}")
                advice = () if scale is None else ({key: scale},)
                yield Finding(key, f"'{name}': {message}", hint, figures, advice)
                break  # one joint tells of its term


def _reason(term: TermView, joint: Joint, drive: Drive, unit: float) -> tuple[str, str, dict[str, float]] | None:
    """Return what is the matter, what to do (empty: another scale), and the figures."""
    if term.kind in _VELOCITY:
        if drive.damping == 0.0:
            return "a speed target acts by the drive's damping, which is 0", "a damping above 0", {"damping": 0.0}
        if unit > drive.velocity:
            text = f"one unit is {unit:g} rad/s, beyond the drive's {drive.velocity:g} rad/s"
            return text, "", {"unit": unit, "limit": drive.velocity}
        return None
    if drive.stiffness == 0.0:
        return "a position target acts by the drive's stiffness, which is 0", "a stiffness above 0", {"stiffness": 0.0}
    if unit * drive.stiffness > drive.effort:
        text = f"one unit is {unit:g} rad or {unit * drive.stiffness:.3g} N·m, beyond the drive's {drive.effort:g} N·m"
        return text, "", {"torque": unit * drive.stiffness}
    if term.kind != _ABSOLUTE or not joint.limited:
        return None
    room, span = _room(joint), joint.high - joint.low
    if unit > room:
        text = f"one unit is {unit:g} rad, and the nearest limit is {room:.3g} rad from the default"
        return text, "", {"unit": unit, "room": room}
    if unit < _TINY * span:
        return f"one unit is {unit:g} rad of a range of {span:.3g} rad", "", {"unit": unit, "span": span}
    return None


def _room(joint: Joint) -> float:
    return min(joint.high - joint.default, joint.default - joint.low)


def _fitting_scale(term: TermView, joints: Iterable[Joint], unit: float) -> float | None:
    """Return the scale nearest to ``unit`` that fits every joint of a term; None when there is none."""
    smallest, largest_one = 0.0, math.inf
    for joint in joints:
        if joint.drive is None:
            continue
        if term.kind in _VELOCITY:
            largest_one = min(largest_one, joint.drive.velocity)
            continue
        if joint.drive.stiffness > 0.0:
            largest_one = min(largest_one, joint.drive.effort / joint.drive.stiffness)
        if term.kind == _ABSOLUTE and joint.limited:
            largest_one = min(largest_one, _room(joint))
            smallest = max(smallest, _TINY * (joint.high - joint.low))
    fitting = at_least(smallest) if unit < smallest else at_most(largest_one)
    return fitting if fitting > 0.0 and smallest <= fitting <= largest_one else None


@rule
def action_clip_never_acts(case: Case) -> Iterator[Finding]:
    """Bounds of an action's target that lie beyond what the joint can do.

    ``clip`` bounds the target in rad or rad/s, not the raw action; outside the joint's limits or the drive's speed
    it never limits anything. Source: Isaac Lab 2.3.2, ``isaaclab/envs/mdp/actions/joint_actions.py``: scale,
    offset, then clip.
    """
    for term in case.terms("actions", _ABSOLUTE, *_VELOCITY):
        joints = case.joints(term.node)
        clips = case.by_joint(term.node.get("clip") or {}, list(joints), None) if term.node.get("clip") else {}
        idle = [name for name, clip in clips.items() if clip is not None and _idle(term, joints[name], clip)]
        if idle:
            joint, clip = joints[idle[0]], clips[idle[0]]
            unit = "rad/s" if term.kind in _VELOCITY else "rad"
            low, high = _reach(term, joint)
            yield Finding(
                f"{term.path}.clip",
                f"targets are clipped to [{clip[0]:g}, {clip[1]:g}] {unit}, and '{idle[0]}' reaches "
                f"[{low:.3g}, {high:.3g}] {unit}: the clip never acts",
                "bounds inside the joint's limits, or no clip; agent.clip_actions bounds raw actions",
                {"clip_low": float(clip[0]), "clip_high": float(clip[1]), "low": low, "high": high},
            )


def _reach(term: TermView, joint: Joint) -> tuple[float, float]:
    if term.kind in _VELOCITY:
        speed = joint.drive.velocity if joint.drive is not None else math.inf
        return -speed, speed
    return joint.low, joint.high


def _idle(term: TermView, joint: Joint, clip: Any) -> bool:
    low, high = _reach(term, joint)
    return bool(clip[0] <= low and clip[1] >= high and math.isfinite(low))


@rule
def command_reach(case: Case) -> Iterator[Finding]:
    """A commanded velocity that the wheels cannot give.

    The top speed is the drive's speed limit times the radius, the top yaw rate twice that over the track; wheels on
    parallel axles cannot go sideways at all. Source: kinematics of a differential drive.
    """
    facts = case.facts
    if not facts.wheels or facts.top_speed == 0.0:
        return
    top = facts.top_speed
    limits = {"lin_vel_x": top, "lin_vel_y": 0.0, "ang_vel_z": 2 * top / facts.track if facts.track else math.inf}
    for term in case.terms("commands", "commands.UniformVelocityCommand"):
        for axis, limit in limits.items():
            size, unit = largest(term.node["ranges"].get(axis)), "rad/s" if axis == "ang_vel_z" else "m/s"
            if size > limit:
                key, most = f"{term.path}.ranges.{axis}", at_most(limit)
                reach = f"the wheels reach {limit:.3g} {unit}" if limit else "wheels do not go sideways"
                yield Finding(
                    key,
                    f"up to {size:g} {unit} is commanded, and {reach}",
                    f"a range within ±{most:g}",
                    {"command": size, "limit": limit},
                    ({key: [-most, most]},),
                )
