"""Reads what one joint leaves free: axes, limits, drives, saved state and passive forces."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pxr import Usd

from wheelleg_exp.asset.description import Dof, Drive, Vec3
from wheelleg_exp.asset.reader.ledger import Ledger
from wheelleg_exp.asset.reader.stage import Stage, schemas
from wheelleg_exp.asset.reader.units import HUGE, Units, effort_limit, endless

UNIT: dict[str, Vec3] = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
D6_AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
FAR = 1e6  # stands for the missing side of a range


@dataclass(frozen=True)
class FreeAxis:
    """One axis that a joint leaves free, in the joint's frame. ``token`` is its name in drives and limits."""

    kind: str
    axis: Vec3
    token: str
    suffix: str = ""


def single_axis(stage: Stage, prim: Usd.Prim, angular: bool) -> list[FreeAxis]:
    """Return the axis of a revolute or prismatic joint; an empty or unknown name is X, as in PhysX."""
    name = stage.ledger.read(prim, "physics:axis", "axis")
    if name not in UNIT:
        stage.ledger.assume(prim.GetPath(), "physics:axis is not given: X", repr(name))
        name = "X"
    token = "angular" if angular else "linear"
    return [FreeAxis("hinge" if angular else "slide", UNIT[name], token)]


def d6_axes(stage: Stage, prim: Usd.Prim) -> list[FreeAxis]:
    """Return the axes that a generic joint leaves free: those without limits, and those whose low <= high."""
    free = []
    for token in D6_AXES:
        low = stage.ledger.read(prim, f"limit:{token}:physics:low", "the choice of free axes")
        high = stage.ledger.read(prim, f"limit:{token}:physics:high", "the choice of free axes")
        if low is not None and high is not None and low >= high:
            continue
        if (low is not None or high is not None) and f"PhysicsLimitAPI:{token}" not in schemas(prim):
            stage.ledger.assume(prim.GetPath(), f"limits of {token} are authored without PhysicsLimitAPI", "honoured")
        free.append(FreeAxis("slide" if token.startswith("trans") else "hinge", UNIT[token[-1]], token, f"_{token}"))
    rotations = [axis for axis in free if axis.kind == "hinge"]
    if len(rotations) == 3 and not any(_d6_range(stage, prim, a.token) for a in rotations):
        free = [axis for axis in free if axis.kind == "slide"]
        free.append(FreeAxis("ball", UNIT["X"], "rot", "_rot" if free else ""))
    return free


def _d6_range(stage: Stage, prim: Usd.Prim, token: str) -> tuple[float, float] | None:
    angular = token.startswith("rot")
    low = stage.ledger.read(prim, f"limit:{token}:physics:low", "range")
    high = stage.ledger.read(prim, f"limit:{token}:physics:high", "range")
    return _range(stage.units, low, high, angular)


def _range(units: Units, low: float | None, high: float | None, angular: bool) -> tuple[float, float] | None:
    """Return a range in rad or m; a hinge is limited only on both sides, a slide on either."""
    no_low, no_high = endless(low, angular), endless(high, angular)
    if (no_low or no_high) if angular else (no_low and no_high):
        return None
    return (
        -FAR if no_low or low is None else units.coordinate(low, angular),
        FAR if no_high or high is None else units.coordinate(high, angular),
    )


def read_range(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> tuple[float, float] | None:
    """Return the limits of one axis in rad or m, None when it has none."""
    if axis.kind == "ball":
        return _cone(stage, prim)
    if axis.suffix:
        return _d6_range(stage, prim, axis.token)
    ledger, angular = stage.ledger, axis.kind == "hinge"
    low = ledger.read(prim, "physics:lowerLimit", "range")
    high = ledger.read(prim, "physics:upperLimit", "range")
    if low is not None and high is not None and low == high:
        ledger.assume(prim.GetPath(), "lower and upper limit are equal: no limits", f"{low:g}")
        ledger.warn(f"{prim.GetPath()}: limits {low:g} to {high:g} are read as none; PhysX locks such a joint")
        return None
    found = _range(stage.units, low, high, angular)
    if found is None and (low is not None or high is not None):
        ledger.assume(prim.GetPath(), "limits are infinite, huge or one-sided: none", f"{low} to {high}")
    return found


def _cone(stage: Stage, prim: Usd.Prim) -> tuple[float, float] | None:
    angles = [stage.ledger.read(prim, f"physics:coneAngle{i}Limit", "range of the ball") for i in (0, 1)]
    given = [a for a in angles if a is not None and 0 <= a < 360]
    if not given:
        return None
    if len(set(given)) > 1:
        stage.ledger.warn(f"{prim.GetPath()}: cone angles {given} differ, the smaller one limits all directions")
    return 0.0, stage.units.coordinate(min(given), True)


def read_drive(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> Drive | None:
    """Return the drive of one axis, None when none is authored. Angular gains are per degree in USD."""
    ledger, units, angular = stage.ledger, stage.units, axis.kind == "hinge"
    prefix = f"drive:{axis.token}:physics:"
    keys = ("stiffness", "damping", "maxForce", "targetPosition", "targetVelocity", "type")
    value = {key: ledger.read(prim, prefix + key, "actuator") for key in keys}
    applied = f"PhysicsDriveAPI:{axis.token}" in schemas(prim)
    if not applied and all(v is None for v in value.values()):
        return None
    if not applied:
        ledger.assume(prim.GetPath(), f"drive of {axis.token} is authored without PhysicsDriveAPI", "honoured")
    kp, kd = (units.gain(value[key] or 0.0, angular) for key in ("stiffness", "damping"))
    limit = effort_limit(value["maxForce"])
    if value["maxForce"] == 0:
        ledger.assume(prim.GetPath(), "a drive's maxForce of 0 is taken for not given", "no effort limit")
    return Drive(
        kind="position" if kp > 0 else "velocity" if kd > 0 else "motor",
        stiffness=kp,
        damping=kd,
        effort=None if limit is None else units.effort(limit, angular),
        target_position=units.coordinate(value["targetPosition"] or 0.0, angular),
        target_velocity=units.coordinate(value["targetVelocity"] or 0.0, angular),
        acceleration=value["type"] == "acceleration",
    )


def read_dof(stage: Stage, prim: Usd.Prim, axis: FreeAxis, name: str, direction: Vec3, anchor: Vec3) -> Dof:
    """Return one degree of freedom, ``direction`` and ``anchor`` (m) in the frame of the body below it."""
    angular = axis.kind != "slide"
    limits = read_range(stage, prim, axis)
    ref = stage.units.coordinate(stage.ledger.read(prim, "mjc:ref", "joint ref") or 0.0, angular)
    passive = _passive(stage, prim, axis, angular)
    state, speed = _state(stage, prim, axis, angular)
    drive = read_drive(stage, prim, axis) if axis.kind != "ball" else None
    stage.ledger.mapped(prim.GetPath(), str(prim.GetTypeName()), f"joint {name} ({axis.kind})")
    return Dof(
        name=name,
        path=str(prim.GetPath()),
        kind="ball" if axis.kind == "ball" else "hinge" if angular else "slide",
        axis=direction,
        anchor=anchor,
        range=limits,
        max_velocity=_velocity_limit(stage, prim, angular),
        force_range=_force_range(stage, prim, angular),
        drive=drive,
        position=_clamped(stage.ledger, prim, state + ref, limits),
        velocity=speed,
        ref=ref,
        **passive,
    )


def _state(stage: Stage, prim: Usd.Prim, axis: FreeAxis, angular: bool) -> tuple[float, float]:
    read, units = stage.ledger.read, stage.units
    position = read(prim, f"state:{axis.token}:physics:position", "keyframe home, qpos")
    velocity = read(prim, f"state:{axis.token}:physics:velocity", "keyframe home, qvel")
    return units.coordinate(position or 0.0, angular), units.coordinate(velocity or 0.0, angular)


def _clamped(ledger: Ledger, prim: Usd.Prim, value: float, limits: tuple[float, float] | None) -> float:
    if limits is None or limits[0] <= value <= limits[1]:
        return value
    inside = min(max(value, limits[0]), limits[1])
    ledger.assume(prim.GetPath(), "the saved state is outside the limits: clamped", f"{value:g} to {inside:g}")
    return inside


def _velocity_limit(stage: Stage, prim: Usd.Prim, angular: bool) -> float | None:
    """Return the speed limit in rad/s or m/s, which MuJoCo has no place for."""
    for name in ("physxJoint:maxJointVelocity", "newton:velocityLimit"):
        value = stage.ledger.read(prim, name)
        if value is None or not value < HUGE:
            continue
        limit = stage.units.coordinate(value, angular)
        unit = "rad/s" if angular else "m/s"
        reason = f"MuJoCo has no velocity limit; kept in the report's velocity_limits in {unit}"
        stage.ledger.leave(prim.GetPath(), name, reason, f"{limit:g} {unit}")
        return limit
    return None


def _force_range(stage: Stage, prim: Usd.Prim, angular: bool) -> tuple[float, float] | None:
    """Return what all motors of a joint together may do, in N·m or N."""
    low, high = (stage.ledger.read(prim, f"mjc:actuatorfrcrange:{end}", "actuatorfrcrange") for end in ("min", "max"))
    if low is not None and high is not None and low < high:
        return float(low), float(high)
    value = effort_limit(stage.ledger.read(prim, "urdf:limit:effort", "actuatorfrcrange"))
    if value is None:
        return None
    effort = stage.units.effort(value, angular)
    return -effort, effort


def _passive(stage: Stage, prim: Usd.Prim, axis: FreeAxis, angular: bool) -> dict[str, float]:
    """Return armature, damping, stiffness and friction loss; mjc wins over newton, newton over physx."""
    units = stage.units
    return {
        "armature": units.rotor(_first(stage, prim, axis, "armature"), angular),
        "frictionloss": units.effort(_first(stage, prim, axis, "friction"), angular),
        "damping": _damping(stage, prim, axis, angular),
        "stiffness": _or_zero(stage.ledger.read(prim, "mjc:stiffness", "stiffness")),
    }


def _or_zero(value: float | None) -> float:
    return 0.0 if value is None else value


_PASSIVE_NAMES = {
    "armature": ("mjc:armature", "newton:armature", "physxJointAxis:{token}:armature", "physxJoint:armature"),
    "friction": ("mjc:frictionloss", "newton:friction", "physxJointAxis:{token}:dynamicFrictionEffort"),
}


def _first(stage: Stage, prim: Usd.Prim, axis: FreeAxis, what: str) -> float:
    became = {"armature": "armature", "friction": "frictionloss"}[what]
    names = [name.format(token=axis.token) for name in _PASSIVE_NAMES[what]]
    values = [stage.ledger.read(prim, name, became) for name in names]
    return next((v for v in values if v is not None and math.isfinite(v)), 0.0)


def _damping(stage: Stage, prim: Usd.Prim, axis: FreeAxis, angular: bool) -> float:
    read, units = stage.ledger.read, stage.units
    per_rad = read(prim, "mjc:damping", "damping")
    per_degree = read(prim, "newton:damping", "damping")
    viscous = read(prim, f"physxJointAxis:{axis.token}:viscousFrictionCoefficient", "damping")
    if per_rad is not None:
        return float(per_rad)
    return units.gain(per_degree if per_degree is not None else viscous or 0.0, angular)
