"""Convert USD joints to degrees of freedom, and find the joint coordinates at which the USD file draws the robot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from pxr import Usd

from wheelleg_exp.asset.rigid_geometry import Frame, rounded, turned, vec3
from wheelleg_exp.asset.robot_description import Dof, Vec3
from wheelleg_exp.asset.usd.bodies.body_tree import Node
from wheelleg_exp.asset.usd.joints.joint_drives import clamped, force_range, read_drive, read_passive, velocity_limit
from wheelleg_exp.asset.usd.joints.usd_joints import FreeAxis, Joint, read_range
from wheelleg_exp.asset.usd.usd_stage import Stage, angle_in_radians

CLOSE_M, CLOSE_RAD = 1e-5, 1e-4


def dofs_of(stage: Stage, node: Node, loops: bool = False) -> tuple[Dof, ...]:
    """Return a body's degrees of freedom; joint positions that USD does not store are computed from the body's pose.

    Coordinates are clamped to the limits; with ``loops``, 0 is not, because moving one joint would break a loop. USD's
    coordinates are motions of body1 relative to body0 about +axis: if body0 is the child, the converter negates the
    axis, but not limits, targets, and gains.
    """
    if node.joint is None:
        return ()
    found = [dof for joint in node.joints for dof in _dofs_of_joint(stage, node, joint)]
    return _compare_drawing(stage, node, tuple(found), loops)


def _dofs_of_joint(stage: Stage, node: Node, joint: Joint) -> list[Dof]:
    frame, sign = node.frame_in_body(joint), -1.0 if node.reversed else 1.0
    if node.reversed and joint.axes:
        rule = "the joint names the child as body0: the axis is negated"
        stage.ledger.assume(joint.path, rule, node.link.name)
    found = []
    # If body0 is the child body, reverse the order of the joint's axes, and negate the axes.
    for axis in reversed(joint.axes) if node.reversed else joint.axes:
        direction = sign * (frame.rotation @ np.array(axis.axis))
        name = joint.name + (axis.suffix if len(joint.axes) > 1 else "")
        found.append(read_dof(stage, joint.prim, axis, name, vec3(direction), vec3(frame.translation)))
    return found


def _compare_drawing(stage: Stage, node: Node, dofs: tuple[Dof, ...], loops: bool) -> tuple[Dof, ...]:
    """Set joint positions from a body's pose in the USD file; report a pose that the body's joints cannot reach."""
    assert node.joint is not None
    drawn = (node.parent.frame.inverse() if node.parent else Frame.identity()) @ node.link.frame
    moved = Frame.of(node.pose).inverse() @ drawn
    values = _coordinates(moved, node, dofs)
    reached = Frame.identity()
    for dof, value in zip(dofs, values, strict=True):
        reached = reached @ _moved(dof, value)
    metres, radians = moved.distance(reached)
    if metres >= CLOSE_M or radians >= CLOSE_RAD:
        rule = "drawn pose and joint frames differ: the frames win"
        stage.ledger.assume(node.link.path, rule, f"{metres:.4g} m, {radians:.4g} rad")
    saved = any(name.startswith("state:") for name in map(str, node.joint.prim.GetAuthoredPropertyNames()))
    drawn_at_zero = all(abs(value) < CLOSE_RAD for value in values)
    if saved or (drawn_at_zero and loops):
        return dofs
    if drawn_at_zero:
        prim = node.joint.prim
        return tuple(replace(d, position=clamped(stage, prim, "zero", d.position, d.range)) for d in dofs)
    shown = ", ".join(f"{value:.6g}" for value in values)
    stage.ledger.assume(node.joint.path, "the file is saved in a bent pose: zero is between the frames", shown)
    found = []
    for dof, value in zip(dofs, values, strict=True):
        position = rounded(value + dof.ref) if abs(value) >= CLOSE_RAD else dof.ref
        position = clamped(stage, node.joint.prim, "the drawn pose", position, dof.range)
        found.append(replace(dof, position=position))
    return tuple(found)


def _coordinates(moved: Frame, node: Node, dofs: tuple[Dof, ...]) -> list[float]:
    """Return the joint coordinates that bring a body as near as possible to the body's pose in the USD file."""
    assert node.joint is not None
    if not dofs or len(node.joints) > 1 or any(dof.kind == "ball" for dof in dofs):
        return [0.0] * len(dofs)
    if len(dofs) == 1:
        return [_coordinate(moved, dofs[0])]
    at_joint = node.frame_in_body(node.joint)
    inside = at_joint.inverse() @ moved @ at_joint
    inside = inside.inverse() if node.reversed else inside
    r = inside.rotation
    middle = math.asin(max(-1.0, min(1.0, float(r[0, 2]))))
    angles = (math.atan2(-r[1, 2], r[2, 2]), middle, math.atan2(-r[0, 1], r[0, 0]))
    values = []
    for axis in reversed(node.joint.axes) if node.reversed else node.joint.axes:  # the order of ``dofs``
        index = "XYZ".index(axis.token[-1])
        values.append(float(inside.translation[index]) if axis.kind == "slide" else angles[index])
    return values


def _coordinate(moved: Frame, dof: Dof) -> float:
    axis = np.array(dof.axis)
    if dof.kind == "slide":
        return float(moved.translation @ axis)
    r = moved.rotation
    twist = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return math.atan2(float(twist @ axis), float(np.trace(r)) - 1.0)


def _moved(dof: Dof, value: float) -> Frame:
    axis = np.array(dof.axis)
    if dof.kind == "slide":
        return Frame(np.eye(3), axis * value)
    turn, anchor = turned(axis, value), np.array(dof.anchor)
    return Frame(turn, anchor - turn @ anchor)


def read_dof(stage: Stage, prim: Usd.Prim, axis: FreeAxis, name: str, direction: Vec3, anchor: Vec3) -> Dof:
    """Return the degree of freedom of a joint axis; ``direction`` and ``anchor`` (m) are in the child body's frame."""
    limits, ref = read_range(stage, prim, axis), 0.0
    if (authored := stage.ledger.read(prim, "mjc:ref", "joint ref")) is not None:
        slides = axis.kind == "slide"
        ref = float(authored) * stage.units.meters if slides else angle_in_radians(stage, float(authored))
    state, speed = _state(stage, prim, axis)
    stage.ledger.mapped(prim.GetPath(), str(prim.GetTypeName()), f"joint {name} ({axis.kind})")
    return Dof(
        name=name,
        path=str(prim.GetPath()),
        kind=axis.kind,
        axis=direction,
        anchor=anchor,
        range=limits,
        max_velocity=velocity_limit(stage, prim, axis),
        force_range=force_range(stage, prim),
        drive=None if axis.kind == "ball" else read_drive(stage, prim, axis, limits, ref),
        position=ref if state is None else clamped(stage, prim, "the saved state", state + ref, limits),
        velocity=speed,
        ref=ref,
        **read_passive(stage, prim, axis),
    )


def _state(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> tuple[float | None, float]:
    read, units, angular = stage.ledger.read, stage.units, axis.kind != "slide"
    position = read(prim, f"state:{axis.token}:physics:position", "keyframe home, qpos")
    velocity = read(prim, f"state:{axis.token}:physics:velocity", "keyframe home, qvel")
    return None if position is None else units.coordinate(position, angular), units.coordinate(velocity or 0.0, angular)
