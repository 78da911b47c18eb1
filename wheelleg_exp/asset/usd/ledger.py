"""Read attributes in plain Python, check each value's kind, and record what became of it: nothing authored is ignored.

A file may give an attribute any type and any number. Text in place of a number, NaN, and numbers that no robot has
are errors that name the prim and the attribute. A value that means "not given" (a mass of 0, an infinite limit) is
not an error: its reader handles it.
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

HUGEST = 1e30  # no length, mass, gain, or force is larger; products of larger numbers would overflow

What = Literal["number", "flag", "text", "vector", "array"]


@dataclass(frozen=True)
class ValueKind:
    """The required kind of a value; ``length`` of a vector; ``endless`` if infinity and huge numbers are allowed."""

    what: What
    length: int = 1
    endless: bool = False


_KINDS: tuple[tuple[str, ValueKind], ...] = (  # patterns of full names
    (r"physics:(lowerLimit|upperLimit|coneAngle[01]Limit|minDistance|maxDistance)", ValueKind("number", endless=True)),
    (r"(limit:\w+:physics:(low|high)|drive:\w+:physics:maxForce)", ValueKind("number", endless=True)),
    (r"physx(Joint|JointAxis:\w+):maxJointVelocity", ValueKind("number", endless=True)),
    (r"newton:(velocityLimit|effortLimit|contact\w+|limit\w+|shellThickness)", ValueKind("number", endless=True)),
    (r"mjc:(actuatorfrcrange|range|\w+Range):(min|max)", ValueKind("number", endless=True)),
    (r"urdf:limit:\w+", ValueKind("number", endless=True)),
    (r"physics:(mass|density|dynamicFriction|staticFriction|restitution)", ValueKind("number")),
    (r"physics:gravityMagnitude", ValueKind("number", endless=True)),
    (r"drive:\w+:physics:(stiffness|damping|targetPosition|targetVelocity)", ValueKind("number")),
    (r"state:\w+:physics:(position|velocity)", ValueKind("number")),
    (r"physxJoint:(armature|jointFriction)", ValueKind("number")),
    (r"physxJointAxis:\w+:(armature|\w+FrictionEffort|viscousFrictionCoefficient)", ValueKind("number")),
    (r"physxMimicJoint:\w+:(gearing|offset|naturalFrequency|dampingRatio)", ValueKind("number")),
    (r"newton:(armature|friction|damping|mimicCoef\d|torsionalFriction|rollingFriction)", ValueKind("number")),
    (r"newton:maxHullVertices", ValueKind("number")),
    (r"urdf:dynamics:\w+", ValueKind("number")),
    (r"mjc:(armature|damping|frictionloss|stiffness|ref|springref|margin|gap|solmix)", ValueKind("number")),
    (r"mjc:(coef\d|inheritRange|width|torqueScale|group|condim|priority|crankLength)", ValueKind("number")),
    (r"mjc:(torsional|rolling)friction", ValueKind("number")),
    (r"mjc:(actDim|maxhullvert|body:gravcomp)", ValueKind("number")),
    (r"mjc:compiler:(boundMass|boundInertia|setTotalMass)", ValueKind("number")),
    (r"mjc:option:(impratio|density|viscosity|o_margin|noslip_\w+|timestep)", ValueKind("number")),
    (r"mjc:(flag:\w+|actEarly|actuatorgravcomp|jointInParent|compiler:(balanceInertia|autoLimits))", ValueKind("flag")),
    (r"physics:(\w+Enabled|excludeFromArticulation|invertFilteredGroups)", ValueKind("flag")),
    (r"physxRigidBody:disableGravity", ValueKind("flag")),
    (r"physxArticulation:(enabledSelfCollisions|articulationEnabled)", ValueKind("flag")),
    (r"newton:(\w+Enabled|jointsAddMobility)", ValueKind("flag")),
    (r"physics:(axis|approximation)", ValueKind("text")),
    (
        r"(drive:\w+:physics:type|physxMaterial:\w+CombineMode|physxMimicJoint:\w+:referenceJointAxis)",
        ValueKind("text"),
    ),
    (r"(newton:massModel|mjc:compiler:angle|physics:mergeGroup)", ValueKind("text")),
    (r"mjc:(type|gainType|biasType|dynType|inertia|\w*[lL]imited)", ValueKind("text")),
    (r"mjc:option:(cone|integrator|jacobian|solver)", ValueKind("text")),
    (r"physics:(diagonalInertia|localPos[01]|gravityDirection|velocity|angularVelocity)", ValueKind("vector", 3)),
    (r"physics:centerOfMass", ValueKind("vector", 3, endless=True)),
    (r"physics:(principalAxes|localRot[01])", ValueKind("vector", 4)),
    (r"newton:inertia", ValueKind("vector", 6)),
    (r"mjc:(gainPrm|biasPrm|dynPrm|gear|solref\w*|solimp\w*|springlength|springdamper|rgba)", ValueKind("array")),
    (r"mjc:(qpos|qvel|act|ctrl|mpos|mquat|option:(wind|magnetic|actuatorgroupdisable|o_\w+))", ValueKind("array")),
    (r"mjc:(path:(coef|divisors|indices|segments)|sideSites:indices)", ValueKind("array")),
)
_EXPECTED = {
    "number": "a number",
    "flag": "true or false",
    "text": "a token",
    "vector": "{length} numbers",
    "array": "an array of numbers",
}


@functools.cache
def kind_of(name: str) -> ValueKind | None:
    """Return the required kind of an attribute by its full name, or None if any value is allowed."""
    return next((kind for pattern, kind in _KINDS if re.fullmatch(pattern, name)), None)


def value_of(attribute: Usd.Attribute, kind: ValueKind | None = None) -> Any:
    """Return an attribute's value as ``plain`` does, after checking it.

    Raises:
        AssetError: the value has another kind, is NaN, or is larger than any number of a robot.
    """
    value = plain(attribute.Get())
    if value is None:
        return None
    wrong = _wrong(value, kind)
    if wrong:
        raise _mistake(attribute, wrong, kind)
    return bool(value) if kind and kind.what == "flag" else value


def number_of(prim: Usd.Prim, name: str) -> float:
    """Return a shape's number, such as ``radius``; the schema's default if not authored.

    Raises:
        AssetError: there is no number, or it is infinite.
    """
    attribute = prim.GetAttribute(name)
    value = value_of(attribute, ValueKind("number")) if attribute else None
    if value is None:
        raise AssetError(f"'{name}' has no value", key=str(prim.GetPath()), expected="a number")
    return float(value)


def _wrong(value: Any, kind: ValueKind | None) -> str:
    """Return what is wrong with a value; an empty text if it is valid."""
    if kind is None or kind.what in ("flag", "text"):
        if _has_nan(value):
            return "is not a number (NaN)"
        fits = kind is None or (isinstance(value, str) if kind.what == "text" else _is_flag(value))
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


def _is_flag(value: Any) -> bool:
    return isinstance(value, (bool, int, float)) and value in (0, 1)


def _has_nan(value: Any) -> bool:
    if isinstance(value, str):
        return False
    array = np.asarray(value)
    return array.dtype.kind == "f" and bool(np.isnan(array).any())


def _shown(value: Any) -> str:
    text = f"'{value}'" if isinstance(value, str) else " ".join(str(value).split())
    return text if len(text) <= 40 else text[:40] + "..."


def _mistake(attribute: Usd.Attribute, wrong: str, kind: ValueKind | None) -> AssetError:
    expected = _EXPECTED[kind.what].format(length=kind.length) if kind else "finite numbers"
    if wrong.startswith("is infinite") or "NaN" in wrong:
        expected = "finite numbers" if kind is None or kind.what in ("vector", "array") else "a finite number"
    return AssetError(
        f"'{attribute.GetName()}' {wrong}",
        key=str(attribute.GetPrim().GetPath()),
        where=_layer(attribute),
        expected=expected,
    )


def _layer(attribute: Usd.Attribute) -> str | None:
    stack = attribute.GetPropertyStack(Usd.TimeCode.Default())
    return stack[0].layer.GetDisplayName() if stack else None


def plain(value: Any) -> Any:
    """Return a value without USD types: numbers, text, tuples, quaternions (w, x, y, z), arrays."""
    if isinstance(value, bool) or value is None or isinstance(value, (int, str)):
        return value
    if isinstance(value, float):
        return (
            single(value) if math.isfinite(value) and abs(value) < 3e38 and float(np.float32(value)) == value else value
        )
    if isinstance(value, (Gf.Quatf, Gf.Quatd, Gf.Quath)):
        return tuple(plain(float(v)) for v in (value.GetReal(), *value.GetImaginary()))
    if isinstance(value, (Gf.Matrix2d, Gf.Matrix3d, Gf.Matrix4d)):
        return np.array(value)
    if isinstance(value, Sdf.AssetPath):
        return value.path
    return _plain_array(value)


def _plain_array(value: Any) -> Any:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return str(value)
    if array.ndim == 1 and array.size <= 6 and array.dtype.kind in "fi":
        return tuple(plain(float(v)) for v in array)
    return array if array.dtype.kind in "fiubU" else str(value)


class Ledger:
    """What was read and what it became, what was assumed, what was left out, and warnings."""

    def __init__(self) -> None:
        self._mapped: dict[tuple[str, str], Mapped] = {}
        self._assumed: dict[tuple[str, str], Assumption] = {}
        self._left: dict[tuple[str, str], dict[str, str]] = {}
        self._left_names: set[tuple[str, str]] = set()
        self._warnings: dict[str, None] = {}
        self._found: dict[tuple[str, str, str], Finding] = {}
        self.authored: dict[str, dict[str, Any]] = {}  # joint attributes in the file's units, by path and name

    def read(self, prim: Usd.Prim, name: str, became: str | None = None) -> Any:
        """Return an attribute's authored value in plain Python, or None.

        Args:
            prim: the attribute's prim.
            name: full name, such as ``physics:mass``; schemas unknown to the USD library work, too.
            became: what the attribute becomes; None if the caller records it later.

        Raises:
            AssetError: the value has a wrong kind, is NaN, or is larger than any number of a robot.
        """
        attribute = prim.GetAttribute(name)
        if not attribute or not attribute.HasAuthoredValue():
            return None
        value = value_of(attribute, kind_of(name))
        # The report shows the file's own numbers of joints next to the converted ones.
        if isinstance(value, (float, int, str)) and prim.IsA(UsdPhysics.Joint):
            self.authored.setdefault(str(prim.GetPath()), {})[name] = value
        if became and value is not None:
            self.mapped(prim.GetPath(), name, became)
        return value

    def targets(self, prim: Usd.Prim, name: str, became: str | None = None) -> list[Sdf.Path]:
        """Return the targets of a relationship, [] if it is not authored."""
        relationship = prim.GetRelationship(name)
        if not relationship or not relationship.HasAuthoredTargets():
            return []
        if became:
            self.mapped(prim.GetPath(), name, became)
        return list(relationship.GetForwardedTargets())

    def mapped(self, path: object, name: str, became: str) -> None:
        """Record what a part of the source became."""
        self._mapped[str(path), name] = Mapped(str(path), name, became)

    def assume(self, path: object, rule: str, value: object) -> None:
        """Record a value that a rule gave and not the file."""
        self._assumed[str(path), rule] = Assumption(str(path), rule, str(value))

    def leave(self, path: object, name: str, reason: str, value: object = "") -> None:
        """Record a part of the source that has no place in the model."""
        self._left_names.add((str(path), name))
        self._left.setdefault((name, reason), {})[str(path)] = str(value)

    def warn(self, text: str) -> None:
        """Record a warning."""
        self._warnings[text] = None

    def find(self, kind: Kind, subject: str, path: object, **numbers: float) -> None:
        """Record a finding, once for each kind, subject, and path; see ``conversion_report`` for kinds and numbers."""
        self._found[kind, subject, str(path)] = Finding(
            kind, subject, str(path), {name: float(value) for name, value in numbers.items()}
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, in the order of recording."""
        return tuple(self._found.values())

    def assumed(self, path: object, rule: str) -> bool:
        """Return whether a rule was used at a path."""
        return (str(path), rule) in self._assumed

    def knows(self, path: object, name: str) -> bool:
        """Return whether an attribute became something or was left out for a reason."""
        key = (str(path), name)
        return key in self._mapped or key in self._left_names

    def left_out(self, path: object, name: str) -> bool:
        """Return whether an attribute was left out for a reason."""
        return (str(path), name) in self._left_names

    def entries(
        self,
    ) -> tuple[tuple[Mapped, ...], tuple[Assumption, ...], tuple[LeftOut, ...], tuple[str, ...]]:
        """Return mapped, assumed, and left-out items and warnings, in the order of recording."""
        left = tuple(LeftOut(name, reason, values) for (name, reason), values in self._left.items())
        mapped = tuple(item for key, item in self._mapped.items() if key not in self._left_names)
        return mapped, tuple(self._assumed.values()), left, tuple(self._warnings)
