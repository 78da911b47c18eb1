"""Turns tree edges into degrees of freedom, and finds the coordinates that the drawing shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from wheelleg_exp.asset.description import Dof
from wheelleg_exp.asset.geometry import Frame, rounded, vec3
from wheelleg_exp.asset.reader.dofs import read_dof
from wheelleg_exp.asset.reader.joints import Joint
from wheelleg_exp.asset.reader.stage import Stage
from wheelleg_exp.asset.reader.tree import Node, drawn_in_parent

CLOSE_M, CLOSE_RAD = 1e-5, 1e-4  # below this a drawing and its joint frames agree


def dofs_of(stage: Stage, node: Node) -> tuple[Dof, ...]:
    """Return the degrees of freedom of a body in its parent; without a saved state, the drawn one is it.

    The coordinate is body1's against body0 about +axis. When the body is body0, its axis is negated, and
    limits, targets and gains stay as authored.
    """
    if node.joint is None:
        return ()
    found = [dof for joint in node.joints for dof in _dofs_of_joint(stage, node, joint)]
    return _compare_drawing(stage, node, tuple(found))


def _dofs_of_joint(stage: Stage, node: Node, joint: Joint) -> list[Dof]:
    frame, sign = node.frame_in_body(joint), -1.0 if node.reversed else 1.0
    if node.reversed and joint.axes:
        rule = "the joint names the child as body0: the axis is negated"
        stage.ledger.assume(joint.path, rule, node.link.name)
    found = []
    for axis in joint.axes:
        direction = sign * (frame.rotation @ np.array(axis.axis))
        name = joint.name + (axis.suffix if len(joint.axes) > 1 else "")
        found.append(read_dof(stage, joint.prim, axis, name, vec3(direction), vec3(frame.translation)))
    return found


def _compare_drawing(stage: Stage, node: Node, dofs: tuple[Dof, ...]) -> tuple[Dof, ...]:
    """Report a drawn pose that the joint cannot reach; keep one that it can as the saved state."""
    drawn, zero = drawn_in_parent(node), Frame.of(node.pose)
    assert node.joint is not None
    if len(dofs) != 1 or dofs[0].kind == "ball":
        _warn_if_apart(stage, node, drawn, zero)
        return dofs
    value = _coordinate(zero.inverse() @ drawn, dofs[0])
    _warn_if_apart(stage, node, drawn, zero @ _moved(dofs[0], value))
    saved = any(stage.ledger.knows(node.joint.path, f"state:{t}:physics:position") for t in ("angular", "linear"))
    if saved or abs(value) < CLOSE_RAD:
        return dofs
    stage.ledger.assume(node.joint.path, "the file is saved in a bent pose: zero is between the frames", f"{value:.6g}")
    return (replace(dofs[0], position=rounded(value + dofs[0].ref)),)


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
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + math.sin(value) * cross + (1 - math.cos(value)) * cross @ cross
    anchor = np.array(dof.anchor)
    return Frame(turn, anchor - turn @ anchor)


def _warn_if_apart(stage: Stage, node: Node, drawn: Frame, reached: Frame) -> None:
    metres, radians = drawn.distance(reached)
    if metres < CLOSE_M and radians < CLOSE_RAD:
        return
    stage.ledger.assume(
        node.link.path,
        "drawn pose and joint frames differ: the frames win",
        f"{metres:.4g} m, {radians:.4g} rad",
    )
