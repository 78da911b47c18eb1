"""Read drives (gains per rad, targets within the limits), passive forces, and velocity and effort limits of joints."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import TypedDict

from pxr import Usd

from wheelleg_exp.asset.conversion_report import is_placeholder
from wheelleg_exp.asset.robot_description import Drive
from wheelleg_exp.asset.usd.joints.usd_joints import TURNS, FreeAxis, Range
from wheelleg_exp.asset.usd.usd_stage import HUGE, Stage, effort_limit, schemas

KEYS = ("stiffness", "damping", "targetPosition", "targetVelocity", "maxForce", "type")


def read_drive(stage: Stage, prim: Usd.Prim, axis: FreeAxis, limits: Range | None, ref: float) -> Drive | None:
    """Return the drive of an axis, if any; its target is in ``limits``, and ``ref`` is MuJoCo's position at USD's 0."""
    values = [stage.ledger.read(prim, f"drive:{axis.token}:physics:{key}", "actuator") for key in KEYS]
    if f"PhysicsDriveAPI:{axis.token}" not in schemas(prim):
        if all(value is None for value in values):
            return None
        stage.ledger.assume(prim.GetPath(), f"drive of {axis.token} is authored without PhysicsDriveAPI", "honoured")
    *numbers, most, kind = values
    stiffness, damping, position, velocity = (number or 0.0 for number in numbers)
    units, angular = stage.units, axis.kind != "slide"
    kp, kd = (max(0.0, units.gain(gain, angular)) for gain in (stiffness, damping))
    target, speed = units.coordinate(position, angular) + ref, units.coordinate(velocity, angular)
    if kp > 0 and kd > 0 and speed:
        # PhysX moves the joint's rest position by this shift.
        shift, name = f"{speed * kd / kp:g} {'rad' if angular else 'm'}", f"drive:{axis.token}:physics:targetVelocity"
        reason = "a position actuator has no target speed; PhysX would rest this far from the target position"
        stage.ledger.leave(prim.GetPath(), name, reason, shift)
        stage.ledger.warn(f"{prim.GetPath()}: {name} was left out: {reason} ({shift})")
    return Drive(
        kind="position" if kp > 0 else "velocity" if kd > 0 else "motor",
        stiffness=kp,
        damping=kd,
        effort=_effort(stage, prim, most, angular),
        target_position=clamped(stage, prim, f"the target of drive:{axis.token}", target, limits),
        target_velocity=speed,
        acceleration=kind == "acceleration",
    )


def _effort(stage: Stage, prim: Usd.Prim, authored: float | None, angular: bool) -> float | None:
    """Return a drive's effort limit in N·m or N; report an implausible effort limit, such as 0, as a placeholder."""
    if authored is not None and authored <= 0:
        rule = f"a drive's maxForce of {authored:g} is taken for not given"
        stage.ledger.assume(prim.GetPath(), rule, "no effort limit")
    limit = effort_limit(authored)
    effort = None if limit is None else stage.units.effort(limit, angular)
    shown = authored if effort is None else effort
    if shown is not None and is_placeholder(shown) and shown < HUGE:
        stage.ledger.find("placeholder_effort", prim.GetName(), prim.GetPath(), value=shown)
    return effort


def clamped(stage: Stage, prim: Usd.Prim, what: str, value: float, limits: Range | None) -> float:
    """Return ``value`` clamped to the joint's limits; record a changed value in the conversion report."""
    if limits is None or limits[0] <= value <= limits[1]:
        return value
    inside = min(max(value, limits[0]), limits[1])
    stage.ledger.assume(prim.GetPath(), f"{what} is outside the limits: clamped", f"{value:g} to {inside:g}")
    return inside


Found = tuple[str, float | None]  # name and SI value

# Each tuple lists the USD attributes of one joint quantity, from the highest to the lowest priority.
_ARMATURE = ("mjc:armature", "newton:armature", "physxJointAxis:armature", "physxJoint:armature")
_FRICTION = (
    *("mjc:frictionloss", "newton:friction"),
    *("physxJointAxis:dynamicFrictionEffort", "physxJointAxis:staticFrictionEffort", "urdf:dynamics:friction"),
)
_DAMPING = ("mjc:damping", "newton:damping", "physxJointAxis:viscousFrictionCoefficient", "urdf:dynamics:damping")
_VELOCITY = (
    *("newton:velocityLimit", "physxJointAxis:maxJointVelocity", "physxJoint:maxJointVelocity"),
    "urdf:limit:velocity",
)
# PhysX's default values of two attributes of the USD schema PhysxJointAxisAPI
_AXIS_FALLBACKS = {"armature": 0.0, "maxJointVelocity": math.inf}


class Passive(TypedDict):
    """The passive forces of one joint axis, by the names of the fields of ``Dof``."""

    armature: float
    frictionloss: float
    damping: float
    stiffness: float


def read_passive(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> Passive:
    """Return an axis's passive forces. MuJoCo's schemas override Newton's, and Newton's override PhysX's."""
    units, angular = stage.units, axis.kind != "slide"

    def winner(became: str, convert: Callable[[float, bool], float], names: Iterable[str]) -> float:
        given = _authored(stage, prim, axis, names, lambda value: convert(value, angular))
        for name, other in given:
            if _agrees(name, other, given[0]):
                stage.ledger.mapped(prim.GetPath(), name, became)
            else:
                stage.ledger.leave(prim.GetPath(), name, f"{given[0][0]} wins over it", f"{other:g}")
        return given[0][1] if given else 0.0

    return {
        "armature": winner("armature", units.rotor, _ARMATURE),
        "frictionloss": winner("frictionloss", units.effort, _FRICTION),
        "damping": winner("damping", units.gain, _DAMPING),
        "stiffness": float(stage.ledger.read(prim, "mjc:stiffness", "stiffness") or 0.0),
    }


def _authored(
    stage: Stage, prim: Usd.Prim, axis: FreeAxis, names: Iterable[str], convert: Callable[[float], float]
) -> list[tuple[str, float]]:
    """Return the usable ones of the attributes ``names``, with their values in SI units."""
    found: list[Found] = []
    for name in names:
        schema, _, what = name.partition(":")
        # PhysxJointAxisAPI has one value per joint axis; all other USD schemas have one value per joint.
        if schema == "physxJointAxis":
            found += _per_axis(stage, prim, axis, what, convert)
        else:
            found.append(_value(stage, prim, name, float if schema in ("mjc", "urdf") else convert))
    return [(name, value) for name, value in found if value is not None]


def _value(stage: Stage, prim: Usd.Prim, name: str, convert: Callable[[float], float]) -> Found:
    value = stage.ledger.read(prim, name)
    usable = value is not None and math.isfinite(value) and value >= 0
    return name, convert(float(value)) if usable else None


def _per_axis(
    stage: Stage, prim: Usd.Prim, axis: FreeAxis, what: str, convert: Callable[[float], float]
) -> Iterator[Found]:
    """Yield a PhysxJointAxisAPI attribute of a joint axis; a ball joint gets the strictest value of its three axes."""
    tokens = TURNS if axis.kind == "ball" else (axis.token,)
    found = [_value(stage, prim, f"physxJointAxis:{token}:{what}", convert) for token in tokens]
    values = [value for _, value in found if value is not None]
    strictest = (min if what == "maxJointVelocity" else max)(values, default=None)
    if len({value for _, value in found}) > 1:
        stage.ledger.warn(f"{prim.GetPath()}: {what} differs between the axes of a ball, {strictest:g} applies to all")
    if strictest is None and any(f"PhysxJointAxisAPI:{token}" in schemas(prim) for token in tokens):
        strictest = _AXIS_FALLBACKS.get(what)
    for index, (name, value) in enumerate(found):
        yield name, strictest if index == 0 else value


def _agrees(name: str, value: float, winner: tuple[str, float]) -> bool:
    """Return whether an attribute has the value of ``winner``, or is the attribute ``winner`` of another joint axis."""
    first, *_, last = winner[0].split(":")
    return value == winner[1] or (name.startswith(f"{first}:") and name.endswith(f":{last}"))


def velocity_limit(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> float | None:
    """Return the velocity limit of a joint axis in rad/s or m/s."""
    angular = axis.kind != "slide"

    def to_si(value: float) -> float:
        return stage.units.coordinate(value, angular) if value < HUGE else math.inf

    given = _authored(stage, prim, axis, _VELOCITY, to_si)
    for _, speed in given:
        if is_placeholder(speed) and speed < math.inf:
            stage.ledger.find("placeholder_velocity", prim.GetName(), prim.GetPath(), value=speed)
    given = [(name, speed) for name, speed in given if speed > 0]
    unit = "rad/s" if angular else "m/s"
    for name, speed in given:
        if speed < math.inf:
            stored = f"MuJoCo has no velocity limit; see the report's velocity_limits in {unit}"
            reason = stored if _agrees(name, speed, given[0]) else f"{given[0][0]} wins over it"
            stage.ledger.leave(prim.GetPath(), name, reason, f"{speed:g} {unit}")
    return given[0][1] if given and given[0][1] < math.inf else None


def force_range(stage: Stage, prim: Usd.Prim) -> tuple[float, float] | None:
    """Return the total force range of a joint's motors, N·m or N; a missing end of the range is 0, as in MuJoCo."""
    low, high = (stage.ledger.read(prim, f"mjc:actuatorfrcrange:{end}", "actuatorfrcrange") for end in ("min", "max"))
    if low is not None or high is not None:
        low, high = float(low or 0.0), float(high or 0.0)
        return (low, high) if low < high else None
    authored = stage.ledger.read(prim, "urdf:limit:effort", "actuatorfrcrange")  # in SI units, as in a URDF
    value = effort_limit(authored)
    if value is None and authored is not None:
        reason = "zero, infinite or huge, which means not given"
        stage.ledger.leave(prim.GetPath(), "urdf:limit:effort", reason, authored)
    return None if value is None else (-value, value)
