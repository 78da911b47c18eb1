"""Read USD attributes as plain Python values, check the values, and record the MJCF part made from each attribute.

A USD attribute can have any type and size. Text in place of a number, NaN, and implausibly large numbers raise an error
with prim and attribute; a mass of 0 or an infinite limit means "not given".
"""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pxr import Gf, Sdf, Usd, UsdPhysics

from wheelleg_exp.asset.conversion_report import Assumption, Finding, Kind, LeftOut, Mapped
from wheelleg_exp.asset.rigid_geometry import single
from wheelleg_exp.errors import AssetError

HUGEST = 1e30  # A USD number above 1e30 is invalid, because a product of such numbers could overflow to infinity.

What = Literal["number", "flag", "text", "vector", "array"]


@dataclass(frozen=True)
class ValueKind:
    """The type that a USD attribute must have; ``length`` is a vector's length, and ``endless`` permits infinity."""

    what: What
    length: int = 1
    endless: bool = False


_KINDS: dict[ValueKind, str] = {  # patterns of full names
    ValueKind("number", endless=True): r"""
        physics:(lowerLimit|upperLimit|coneAngle[01]Limit|minDistance|maxDistance)
        (limit:\w+:physics:(low|high)|drive:\w+:physics:maxForce) physx(Joint|JointAxis:\w+):maxJointVelocity
        newton:(velocityLimit|effortLimit|contact\w+|limit\w+|shellThickness)
        mjc:(actuatorfrcrange|range|\w+Range):(min|max) urdf:limit:\w+ physics:gravityMagnitude
    """,
    ValueKind("number"): r"""
        physics:(mass|density|dynamicFriction|staticFriction|restitution)
        drive:\w+:physics:(stiffness|damping|targetPosition|targetVelocity) state:\w+:physics:(position|velocity)
        physxJoint:(armature|jointFriction) physxJointAxis:\w+:(armature|\w+FrictionEffort|viscousFrictionCoefficient)
        physxMimicJoint:\w+:(gearing|offset|naturalFrequency|dampingRatio)
        newton:(armature|friction|damping|mimicCoef\d|torsionalFriction|rollingFriction) newton:maxHullVertices
        urdf:dynamics:\w+ mjc:(armature|damping|frictionloss|stiffness|ref|springref|margin|gap|solmix)
        mjc:(coef\d|inheritRange|width|torqueScale|group|condim|priority|crankLength) mjc:(torsional|rolling)friction
        mjc:(actDim|maxhullvert|body:gravcomp) mjc:compiler:(boundMass|boundInertia|setTotalMass)
        mjc:option:(impratio|density|viscosity|o_margin|noslip_\w+|timestep)
    """,
    ValueKind("flag"): r"""
        mjc:(flag:\w+|actEarly|shellinertia|actuatorgravcomp|jointInParent|compiler:(balanceInertia|autoLimits))
        physics:(\w+Enabled|excludeFromArticulation|invertFilteredGroups) physxRigidBody:disableGravity
        physxArticulation:(enabledSelfCollisions|articulationEnabled) newton:(\w+Enabled|jointsAddMobility)
    """,
    ValueKind("text"): r"""
        physics:(axis|approximation)
        (drive:\w+:physics:type|physxMaterial:\w+CombineMode|physxMimicJoint:\w+:referenceJointAxis)
        (newton:massModel|mjc:compiler:angle|physics:mergeGroup)
        mjc:(type|gainType|biasType|dynType|inertia|\w*[lL]imited) mjc:option:(cone|integrator|jacobian|solver)
    """,
    ValueKind("vector", 3): r"""
        physics:(diagonalInertia|localPos[01]|gravityDirection|velocity|angularVelocity)
    """,
    ValueKind("vector", 3, endless=True): r"physics:centerOfMass",
    ValueKind("vector", 4): r"physics:(principalAxes|localRot[01])",
    ValueKind("vector", 6): r"newton:inertia",
    ValueKind("array"): r"""
        mjc:(gainPrm|biasPrm|dynPrm|gear|solref\w*|solimp\w*|springlength|springdamper|rgba)
        mjc:(qpos|qvel|act|ctrl|mpos|mquat|option:(wind|magnetic|actuatorgroupdisable|o_\w+))
        mjc:(path:(coef|divisors|indices|segments)|sideSites:indices)
    """,
}
_EXPECTED = {
    **{"number": "a number", "flag": "true or false", "text": "a token"},
    **{"vector": "{length} numbers", "array": "an array of numbers"},
}


@functools.cache
def kind_of(name: str) -> ValueKind | None:
    """Return the type that the USD attribute ``name`` must have; None if every type is allowed."""
    return next((kind for kind, texts in _KINDS.items() if any(re.fullmatch(t, name) for t in texts.split())), None)


def value_of(attribute: Usd.Attribute, kind: ValueKind | None = None) -> Any:
    """Return a USD attribute's value in plain Python; raise AssetError if the value has a wrong type."""
    value = plain(attribute.Get())
    if value is None:
        return None
    wrong = _wrong(value, kind)
    if wrong:
        expected = _EXPECTED[kind.what].format(length=kind.length) if kind else "finite numbers"
        if wrong.startswith("is infinite") or "NaN" in wrong:
            expected = "finite numbers" if kind is None or kind.what in ("vector", "array") else "a finite number"
        stack = attribute.GetPropertyStack(Usd.TimeCode.Default())
        message, key = f"'{attribute.GetName()}' {wrong}", str(attribute.GetPrim().GetPath())
        raise AssetError(message, key=key, where=stack[0].layer.GetDisplayName() if stack else None, expected=expected)
    return bool(value) if kind and kind.what == "flag" else value


def number_of(prim: Usd.Prim, name: str) -> float:
    """Return a number of a USD shape, such as ``radius``; the schema's default if the number is not authored."""
    attribute = prim.GetAttribute(name)
    value = value_of(attribute, ValueKind("number")) if attribute else None
    if value is None:
        raise AssetError(f"'{name}' has no value", key=str(prim.GetPath()), expected="a number")
    return float(value)


def _wrong(value: object, kind: ValueKind | None) -> str:
    """Return the text of an error message for an invalid USD value, or an empty string for a valid value."""
    if kind is None or kind.what in ("flag", "text"):
        numbers = np.zeros(0) if isinstance(value, str) else np.asarray(value)
        if numbers.dtype.kind == "f" and np.isnan(numbers).any():
            return "is not a number (NaN)"
        flag = isinstance(value, (int, float)) and value in (0, 1)
        fits = kind is None or (isinstance(value, str) if kind.what == "text" else flag)
        return "" if fits else f"is {_shown(value)}"
    if (kind.what == "number") != (isinstance(value, (int, float)) and not isinstance(value, bool)):
        return f"is {_shown(value)}"
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or (kind.what == "vector" and array.shape != (kind.length,)) or array.ndim > 1:
        return f"is {_shown(value)}"
    if np.isnan(array).any():
        return "is not a number (NaN)"
    if not kind.endless and (np.abs(array) >= HUGEST).any():
        return "is infinite or larger than any robot's"
    return ""


def _shown(value: object) -> str:
    text = f"'{value}'" if isinstance(value, str) else " ".join(str(value).split())
    return text if len(text) <= 40 else text[:40] + "..."


def plain(value: object) -> object:
    """Return a value without USD types: numbers, text, tuples, quaternions (w, x, y, z), arrays."""
    if isinstance(value, bool) or value is None or isinstance(value, (int, str)):
        return value
    if isinstance(value, float):
        is_single = math.isfinite(value) and abs(value) < 3e38 and float(np.float32(value)) == value
        return single(value) if is_single else value
    if isinstance(value, (Gf.Quatf, Gf.Quatd, Gf.Quath)):
        return tuple(plain(float(v)) for v in (value.GetReal(), *value.GetImaginary()))
    if isinstance(value, (Gf.Matrix2d, Gf.Matrix3d, Gf.Matrix4d)):
        return np.array(value)
    if isinstance(value, Sdf.AssetPath):
        return value.path
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return str(value)
    if array.ndim == 1 and array.size <= 6 and array.dtype.kind in "fi":
        return tuple(plain(float(v)) for v in array)
    return array if array.dtype.kind in "fiubU" else str(value)


class Ledger:
    """The records of a conversion: attributes read, assumptions, omitted physics, findings, and warnings."""

    def __init__(self) -> None:
        self._mapped: dict[tuple[str, str], Mapped] = {}
        self._assumed: dict[tuple[str, str], Assumption] = {}
        self._left: dict[tuple[str, str], dict[str, str]] = {}
        self._left_names: set[tuple[str, str]] = set()
        self._warnings: dict[str, None] = {}
        self._found: dict[tuple[str, str, str], Finding] = {}
        self.authored: dict[str, dict[str, object]] = {}

    def read(self, prim: Usd.Prim, name: str, became: str | None = None) -> Any:
        """Return an attribute's authored value or None, and record ``became``, the MJCF part made from the value."""
        attribute = prim.GetAttribute(name)
        if not attribute or not attribute.HasAuthoredValue():
            return None
        value = value_of(attribute, kind_of(name))
        # Store the USD values of joints, because the conversion report shows them next to the converted values.
        if isinstance(value, (float, int, str)) and prim.IsA(UsdPhysics.Joint):
            self.authored.setdefault(str(prim.GetPath()), {})[name] = value
        if became and value is not None:
            self.mapped(prim.GetPath(), name, became)
        return value

    def targets(self, prim: Usd.Prim, name: str, became: str | None = None) -> list[Sdf.Path]:
        """Return the target paths of a USD relationship, and record ``became``, the MJCF part made from the paths."""
        relationship = prim.GetRelationship(name)
        if not relationship or not relationship.HasAuthoredTargets():
            return []
        if became:
            self.mapped(prim.GetPath(), name, became)
        return list(relationship.GetForwardedTargets())

    def mapped(self, path: object, name: str, became: str) -> None:
        """Record that the robot file's attribute or element ``name`` became the MJCF part ``became``."""
        self._mapped[str(path), name] = Mapped(str(path), name, became)

    def assume(self, path: object, rule: str, value: object) -> None:
        """Record that the robot file lacks a value, and that the converter assumed ``value`` by the rule ``rule``."""
        self._assumed[str(path), rule] = Assumption(str(path), rule, str(value))

    def leave(self, path: object, name: str, reason: str, value: object = "") -> None:
        """Record that the MJCF omits the robot file's attribute or element ``name``."""
        self._left_names.add((str(path), name))
        self._left.setdefault((name, reason), {})[str(path)] = str(value)

    def leave_and_warn(self, path: object, name: str, reason: str, what: str, value: object = "") -> None:
        """Record that the MJCF omits the attribute or element ``name``; ``what`` names it in a warning to the user."""
        self.leave(path, name, reason, value)
        self.warn(f"{path}: {what} was left out: {reason}")

    def warn(self, text: str) -> None:
        """Record a warning, unless a warning with the same text is already recorded."""
        self._warnings[text] = None

    def find(self, kind: Kind, subject: str, path: object, **numbers: float) -> None:
        """Add an entry of a kind such as ``no_colliders``, with measured ``numbers``, to the conversion report."""
        plain_numbers = {name: float(value) for name, value in numbers.items()}
        self._found[kind, subject, str(path)] = Finding(kind, subject, str(path), plain_numbers)

    @property
    def findings(self) -> tuple[Finding, ...]:
        return tuple(self._found.values())

    def knows(self, path: object, name: str) -> bool:
        """Return whether the USD attribute ``name`` is already recorded, as converted or as omitted."""
        key = (str(path), name)
        return key in self._mapped or key in self._left_names

    def left_out(self, path: object, name: str) -> bool:
        """Return whether the robot file's attribute or element ``name`` is recorded as omitted from the MJCF."""
        return (str(path), name) in self._left_names

    def entries(self) -> tuple[tuple[Mapped, ...], tuple[Assumption, ...], tuple[LeftOut, ...], tuple[str, ...]]:
        """Return a conversion's records: converted attributes, assumptions, omitted attributes, and warnings."""
        left = tuple(LeftOut(name, reason, values) for (name, reason), values in self._left.items())
        mapped = tuple(item for key, item in self._mapped.items() if key not in self._left_names)
        return mapped, tuple(self._assumed.values()), left, tuple(self._warnings)
