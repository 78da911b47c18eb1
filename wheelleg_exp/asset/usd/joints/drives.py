"""Reads the drives of joints: gains per degree become gains per rad, and targets stay inside the limits."""

from __future__ import annotations

from typing import Any

from pxr import Usd

from wheelleg_exp.asset.description import Drive
from wheelleg_exp.asset.findings import is_placeholder
from wheelleg_exp.asset.usd.joints.axes import FreeAxis
from wheelleg_exp.asset.usd.joints.limits import Range
from wheelleg_exp.asset.usd.stage import Stage, schemas
from wheelleg_exp.asset.usd.units import HUGE, effort_limit

KEYS = ("stiffness", "damping", "maxForce", "targetPosition", "targetVelocity", "type")


def read_drive(stage: Stage, prim: Usd.Prim, axis: FreeAxis, limits: Range | None, ref: float) -> Drive | None:
    """Return the drive of one axis, None when none is authored.

    Args:
        stage: the open stage.
        prim: the joint.
        axis: the axis that the drive turns or pushes.
        limits: the axis' range in rad or m; the target is clamped into it.
        ref: coordinate of the joint where USD's is zero.
    """
    value = _values(stage, prim, axis.token)
    if value is None:
        return None
    units, angular = stage.units, axis.kind != "slide"
    kp, kd = (max(0.0, units.gain(value[key] or 0.0, angular)) for key in ("stiffness", "damping"))
    limit = _effort(stage, prim, value["maxForce"])
    target = units.coordinate(value["targetPosition"] or 0.0, angular) + ref
    speed = units.coordinate(value["targetVelocity"] or 0.0, angular)
    if kp > 0 and kd > 0 and speed:
        _leave_speed(stage, prim, axis, speed * kd / kp)
    return Drive(
        kind="position" if kp > 0 else "velocity" if kd > 0 else "motor",
        stiffness=kp,
        damping=kd,
        effort=_noted(stage, prim, value["maxForce"], None if limit is None else units.effort(limit, angular)),
        target_position=clamped(stage, prim, f"the target of drive:{axis.token}", target, limits),
        target_velocity=speed,
        acceleration=value["type"] == "acceleration",
    )


def _leave_speed(stage: Stage, prim: Usd.Prim, axis: FreeAxis, shift: float) -> None:
    """Say that a position actuator follows no speed; in PhysX the drive rests ``shift`` (rad or m) from its target."""
    name = f"drive:{axis.token}:physics:targetVelocity"
    unit = "m" if axis.kind == "slide" else "rad"
    reason = "a position actuator has no target of speed; PhysX would rest this far from the target position"
    stage.ledger.leave(prim.GetPath(), name, reason, f"{shift:g} {unit}")
    stage.ledger.warn(f"{prim.GetPath()}: {name} was left out: {reason} ({shift:g} {unit})")


def _values(stage: Stage, prim: Usd.Prim, token: str) -> dict[str, Any] | None:
    value = {key: stage.ledger.read(prim, f"drive:{token}:physics:{key}", "actuator") for key in KEYS}
    applied = f"PhysicsDriveAPI:{token}" in schemas(prim)
    if not applied and all(v is None for v in value.values()):
        return None
    if not applied:
        stage.ledger.assume(prim.GetPath(), f"drive of {token} is authored without PhysicsDriveAPI", "honoured")
    return value


def _effort(stage: Stage, prim: Usd.Prim, authored: float | None) -> float | None:
    if authored is not None and authored <= 0:
        rule = f"a drive's maxForce of {authored:g} is taken for not given"
        stage.ledger.assume(prim.GetPath(), rule, "no effort limit")
    return effort_limit(authored)


def _noted(stage: Stage, prim: Usd.Prim, authored: float | None, effort: float | None) -> float | None:
    """Return an effort limit (N·m or N), after recording one that no motor has; infinity is none, and meant."""
    shown = authored if effort is None else effort
    if shown is not None and is_placeholder(shown) and shown < HUGE:
        stage.ledger.find("placeholder_effort", prim.GetName(), prim.GetPath(), value=shown)
    return effort


def clamped(stage: Stage, prim: Usd.Prim, what: str, value: float, limits: Range | None) -> float:
    """Return a coordinate inside the limits, and say so when it was outside."""
    if limits is None or limits[0] <= value <= limits[1]:
        return value
    inside = min(max(value, limits[0]), limits[1])
    stage.ledger.assume(prim.GetPath(), f"{what} is outside the limits: clamped", f"{value:g} to {inside:g}")
    return inside
