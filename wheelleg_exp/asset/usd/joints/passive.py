"""Reads what acts on a joint without a drive, and what bounds its speed and effort."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from pxr import Usd

from wheelleg_exp.asset.findings import is_placeholder
from wheelleg_exp.asset.usd.joints.axes import TURNS, FreeAxis
from wheelleg_exp.asset.usd.stage import Stage, schemas
from wheelleg_exp.asset.usd.units import HUGE, effort_limit

Found = tuple[str, float | None]  # an attribute and its value in SI units, None where it says nothing

# What says it, the first that is authored wins; of PhysX's schema of an axis, that of the axis.
_ARMATURE = ("mjc:armature", "newton:armature", "physxJointAxis:armature", "physxJoint:armature")
_FRICTION = (
    *("mjc:frictionloss", "newton:friction"),
    *("physxJointAxis:dynamicFrictionEffort", "physxJointAxis:staticFrictionEffort", "urdf:dynamics:friction"),
)
_DAMPING = ("mjc:damping", "newton:damping", "physxJointAxis:viscousFrictionCoefficient", "urdf:dynamics:damping")


@dataclass(frozen=True)
class Passive:
    """Armature in kg·m² (kg), friction loss in N·m (N), damping per rad/s (m/s), stiffness per rad (m)."""

    armature: float
    frictionloss: float
    damping: float
    stiffness: float


def read_passive(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> Passive:
    """Return the passive forces on one axis; MuJoCo's schemas win over Newton's, and Newton's over PhysX's."""
    units, angular = stage.units, axis.kind != "slide"

    def winner(became: str, convert: Callable[[float, bool], float], *names: str) -> float:
        def to_si(value: float) -> float:
            return convert(value, angular)

        found: list[Found] = []
        for name in names:
            schema, _, what = name.partition(":")
            if schema == "physxJointAxis":
                found += _per_axis(stage, prim, axis, what, to_si)
            else:
                found.append(_value(stage, prim, name, float if schema in ("mjc", "urdf") else to_si))
        return _winner(stage, prim, became, found)

    return Passive(
        armature=winner("armature", units.rotor, *_ARMATURE),
        frictionloss=winner("frictionloss", units.effort, *_FRICTION),
        damping=winner("damping", units.gain, *_DAMPING),
        stiffness=_spring(stage, prim),
    )


def _spring(stage: Stage, prim: Usd.Prim) -> float:
    value = stage.ledger.read(prim, "mjc:stiffness", "stiffness")
    return 0.0 if value is None else float(value)


def _value(stage: Stage, prim: Usd.Prim, name: str, convert: Callable[[float], float]) -> Found:
    value = stage.ledger.read(prim, name)
    usable = value is not None and math.isfinite(value) and value >= 0
    return name, convert(float(value)) if usable else None


def _per_axis(
    stage: Stage, prim: Usd.Prim, axis: FreeAxis, what: str, convert: Callable[[float], float]
) -> Iterable[Found]:
    """Yield what PhysxJointAxisAPI says of an axis, for a ball the largest of its three.

    Where that schema is applied, an unauthored armature is 0, and PhysxJointAPI does not count.
    """
    tokens = TURNS if axis.kind == "ball" else (axis.token,)
    found = [_value(stage, prim, f"physxJointAxis:{token}:{what}", convert) for token in tokens]
    largest = max((value for _, value in found if value is not None), default=None)
    if len({value for _, value in found}) > 1:
        stage.ledger.warn(f"{prim.GetPath()}: {what} differs between the axes of a ball, the largest goes for all")
    if (
        largest is None
        and what == "armature"
        and any(f"PhysxJointAxisAPI:{token}" in schemas(prim) for token in tokens)
    ):
        largest = 0.0
    for index, (name, value) in enumerate(found):
        yield name, largest if index == 0 else value


def _winner(stage: Stage, prim: Usd.Prim, became: str, found: list[Found]) -> float:
    """Return the first value there is; the others that are authored lose, and the report says so."""
    given = [(name, value) for name, value in found if value is not None]
    if not given:
        return 0.0
    first, value = given[0]
    for name, other in given:
        if name.split(":")[0] == first.split(":")[0] and name.rsplit(":", 1)[-1] == first.rsplit(":", 1)[-1]:
            stage.ledger.mapped(prim.GetPath(), name, became)
        else:
            stage.ledger.leave(prim.GetPath(), name, f"{first} wins over it", f"{other:g}")
    return value


def velocity_limit(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> float | None:
    """Return the speed limit of an axis in rad/s or m/s, which MuJoCo has no place for."""
    angular, limit = axis.kind != "slide", None
    names = (f"physxJointAxis:{axis.token}:maxJointVelocity", "physxJoint:maxJointVelocity", "newton:velocityLimit")
    for name in names:
        value = stage.ledger.read(prim, name)
        if value == 0:
            stage.ledger.find("placeholder_velocity", prim.GetName(), prim.GetPath(), value=0.0)
        if value is None or not 0 < value < HUGE:
            continue
        speed, unit = stage.units.coordinate(value, angular), "rad/s" if angular else "m/s"
        reason = f"MuJoCo has no velocity limit; kept in the report's velocity_limits in {unit}"
        stage.ledger.leave(prim.GetPath(), name, reason, f"{speed:g} {unit}")
        if is_placeholder(speed):
            stage.ledger.find("placeholder_velocity", prim.GetName(), prim.GetPath(), value=speed)
        limit = speed if limit is None else limit
    return limit


def force_range(stage: Stage, prim: Usd.Prim, angular: bool) -> tuple[float, float] | None:
    """Return what all motors of a joint together may do, in N·m or N.

    One side alone is authored where the other is MuJoCo's default, 0.
    """
    low, high = (stage.ledger.read(prim, f"mjc:actuatorfrcrange:{end}", "actuatorfrcrange") for end in ("min", "max"))
    if low is not None or high is not None:
        low, high = float(low or 0.0), float(high or 0.0)
        return (low, high) if low < high else None
    value = effort_limit(stage.ledger.read(prim, "urdf:limit:effort", "actuatorfrcrange"))
    return None if value is None else (-stage.units.effort(value, angular), stage.units.effort(value, angular))
