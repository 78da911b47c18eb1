"""Turns a URDF's joints into degrees of freedom: axes as MuJoCo reads them, limits and couplings from the XML."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.asset.description import Coupling, Dof, Vec3
from wheelleg_exp.asset.findings import is_placeholder
from wheelleg_exp.asset.urdf.document import Document
from wheelleg_exp.asset.urdf.kinematics import Joint, Tree
from wheelleg_exp.asset.urdf.mujoco_reader import Axis, Seen
from wheelleg_exp.asset.urdf.xml import Element
from wheelleg_exp.asset.usd.units import HUGE, effort_limit, endless
from wheelleg_exp.errors import nearest_name

FAR = 1e6  # stands for the missing side of a range
UNIT_LENGTH = 1e-6  # an axis this near to length 1 is kept as written
PLANAR = ("_transX", "_transY", "_rotZ")  # in the frame whose z is the joint's axis

Range = tuple[float, float]


def dofs_of(document: Document, joint: Joint, seen: Seen) -> tuple[Dof, ...]:
    """Return the degrees of freedom of a joint; none for a weld, and none for a floating one."""
    axes = seen.axes if joint.kind != "floating" else ()
    document.ledger.mapped(joint.element.path, "joint", _became(joint, axes))
    suffixes = PLANAR if joint.kind == "planar" else ("",)
    if not axes:
        return ()
    limits = _limits(document, joint)
    return tuple(_dof(document, joint, axis, suffix, limits) for axis, suffix in zip(axes, suffixes, strict=True))


def _became(joint: Joint, axes: tuple[Axis, ...]) -> str:
    if joint.kind == "floating":
        return "freejoint"
    if not axes:
        return "a weld to the parent body"
    return f"joint {joint.name} ({', '.join(axis.kind for axis in axes)})"


def _dof(document: Document, joint: Joint, axis: Axis, suffix: str, limits: _Limits) -> Dof:
    own = not suffix  # a planar joint's limits do not say which of its three they mean
    return Dof(
        name=joint.name + suffix,
        path=joint.element.path,
        kind=axis.kind,
        axis=_direction(document, joint, axis.axis),
        anchor=(0.0, 0.0, 0.0),
        range=limits.range if own else None,
        damping=axis.damping,
        frictionloss=axis.friction,
        max_velocity=limits.velocity if own else None,
        force_range=limits.effort if own else None,
    )


def _direction(document: Document, joint: Joint, axis: Vec3) -> Vec3:
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) < UNIT_LENGTH:
        return axis
    document.ledger.assume(joint.element.path, "the axis is not of unit length: its direction", f"length {length:.6g}")
    x, y, z = (value / length for value in axis)
    return x, y, z


@dataclass(frozen=True)
class _Limits:
    """A joint's ``<limit>``: range in rad or m, effort in N·m or N, velocity in rad/s or m/s; None: none."""

    range: Range | None = None
    effort: Range | None = None
    velocity: float | None = None


def _limits(document: Document, joint: Joint) -> _Limits:
    element = joint.element.first("limit")
    if joint.kind in ("planar", "spherical"):
        return _Limits()  # the audit names what stands there
    if element is None:
        return _Limits(_range(document, joint, None))
    return _Limits(
        _range(document, joint, element), _effort(document, joint, element), _velocity(document, joint, element)
    )


def _range(document: Document, joint: Joint, element: Element | None) -> Range | None:
    """Return the limits of a hinge or slide. A side that is not written is 0, says URDF."""
    if joint.kind == "continuous":
        _note_ignored(document, joint, element)
        return None
    ledger, path, angular = document.ledger, joint.element.path, joint.kind == "revolute"
    found = [_written(document, joint, element, side, "range") for side in ("lower", "upper")]
    low, high = (0.0 if value is None else value for value in found)
    if low >= high:
        written = {side: value for side, value in zip(("lower", "upper"), found, strict=True) if value is not None}
        ledger.find("no_limits", joint.name, path, **written)
    if low == high:
        what = f"limits {low:g} to {high:g}" if element else "no <limit>"
        ledger.assume(path, "lower and upper limit are equal, or not given: no limits", what)
        ledger.warn(f"{path}: {what}, read as no limits; other simulators lock such a joint")
        return None
    if low > high:
        ledger.assume(path, "the lower limit is above the upper one: no limits", f"{low:g} to {high:g}")
        ledger.warn(f"{path}: limits {low:g} to {high:g} are the wrong way round and were read as none")
        return None
    if None in found:
        ledger.assume(path, "only one limit is given: the other is 0, as URDF says", f"{low:g} to {high:g}")
    no_low, no_high = (endless(math.degrees(value) if angular else value, angular) for value in (low, high))
    if (no_low or no_high) if angular else (no_low and no_high):
        ledger.assume(path, "limits are infinite or huge: none", f"{low:g} to {high:g}")
        return None
    return (-FAR if no_low else low, FAR if no_high else high)


def _note_ignored(document: Document, joint: Joint, element: Element | None) -> None:
    """Say that a joint that turns without end has limits all the same, where it has; they are left to the audit."""
    if element is None or not {"lower", "upper"} <= set(element.attributes):
        return
    low, high = (_written(document, joint, element, side, None) for side in ("lower", "upper"))
    if low is None or high is None or not low < high or endless(math.degrees(low), True):
        return
    path = joint.element.path
    document.ledger.find("limits_ignored", joint.name, path, lower=low, upper=high)
    document.ledger.warn(f"{path}: a continuous joint has no limits; {low:g} to {high:g} are written and do not count")


def _written(document: Document, joint: Joint, element: Element | None, name: str, became: str | None) -> float | None:
    """Return a number of ``<limit>``, and keep it as the file has it."""
    value = None if element is None else document.number(element, name, became, endless=True)
    if value is not None:
        document.ledger.authored.setdefault(joint.element.path, {})[name] = value
    return value


def _effort(document: Document, joint: Joint, element: Element) -> Range | None:
    value = _written(document, joint, element, "effort", "joint actuatorfrcrange")
    if value is not None and math.isfinite(value) and is_placeholder(value):
        document.ledger.find("placeholder_effort", joint.name, joint.element.path, value=value)
    limit = effort_limit(None if value is None else abs(value))
    if limit is None:
        if value is not None:
            document.ledger.leave(element.path, "effort", "zero, infinite or huge, which means not given", value)
        return None
    return -limit, limit


def _velocity(document: Document, joint: Joint, element: Element) -> float | None:
    value = _written(document, joint, element, "velocity", "velocity_limits")
    if value is None:
        return None
    if math.isfinite(value) and is_placeholder(value):
        document.ledger.find("placeholder_velocity", joint.name, joint.element.path, value=value)
    limit = abs(value)
    if limit == 0 or limit >= HUGE:
        document.ledger.leave(element.path, "velocity", "zero, infinite or huge, which means not given", value)
        return None
    unit = "m/s" if joint.kind == "prismatic" else "rad/s"
    reason = f"MuJoCo has no velocity limit; kept in the report's velocity_limits in {unit}"
    document.ledger.leave(element.path, "velocity", reason, f"{limit:g} {unit}")
    return limit


def couplings(document: Document, tree: Tree, dofs: dict[str, Dof]) -> tuple[Coupling, ...]:
    """Return the joints that follow another one: q = offset + multiplier · r.

    Args:
        document: the URDF.
        tree: its joints.
        dofs: the degree of freedom of each hinge and slide, by the joint's name.
    """
    found = []
    for joint in tree.joints.values():
        element = joint.element.first("mimic")
        if element is not None:
            coupling = _coupling(document, joint, element, tree, dofs)
            found += [coupling] if coupling else []
    return tuple(found)


def _coupling(document: Document, joint: Joint, element: Element, tree: Tree, dofs: dict[str, Dof]) -> Coupling | None:
    leader = document.required(element, "joint", "equality joint")
    multiplier = document.number(element, "multiplier", "equality joint polycoef")
    offset = document.number(element, "offset", "equality joint polycoef")
    if joint.name not in dofs or leader not in dofs or leader == joint.name:
        _leave_coupling(document, element, leader, tree)
        return None
    ratio = 1.0 if multiplier is None else multiplier
    return Coupling(
        f"{joint.name}_coupling",
        element.path,
        dofs[joint.name].name,
        dofs[leader].name,
        (offset or 0.0, ratio, 0.0, 0.0, 0.0),
    )


def _leave_coupling(document: Document, element: Element, leader: str, tree: Tree) -> None:
    reason = "only a hinge or slide can follow another one"
    if leader not in tree.joints:
        nearest = nearest_name(leader, tree.joints)
        reason = f"there is no joint '{leader}'" + (f"; was '{nearest}' meant?" if nearest else "")
    document.ledger.leave(element.path, "joint", reason, leader)
    document.ledger.warn(f"{element.path}: the coupling was left out: {reason}")
