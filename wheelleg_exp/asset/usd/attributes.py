"""Attribute values in plain Python, and which kind of value each physics attribute has to hold.

A file may give an attribute any type and any number. Text where a number belongs, NaN, and numbers that no robot has
are mistakes, told with the prim and the name. What means "not given" (a mass of 0, an infinite limit) is none: whoever
reads it knows.
"""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pxr import Gf, Sdf, Usd

from wheelleg_exp.asset.geometry import single
from wheelleg_exp.errors import AssetError

HUGEST = 1e30  # no length, mass, gain or force is larger, and a double of 1e300 overflows what is computed from it

What = Literal["number", "flag", "text", "vector", "array"]


@dataclass(frozen=True)
class Kind:
    """What a value has to be; ``length`` of a vector; whether infinity and huge numbers have a meaning."""

    what: What
    length: int = 1
    endless: bool = False


_KINDS: tuple[tuple[str, Kind], ...] = (  # full names as patterns
    (r"physics:(lowerLimit|upperLimit|coneAngle[01]Limit|minDistance|maxDistance)", Kind("number", endless=True)),
    (r"(limit:\w+:physics:(low|high)|drive:\w+:physics:maxForce)", Kind("number", endless=True)),
    (r"physx(Joint|JointAxis:\w+):maxJointVelocity", Kind("number", endless=True)),
    (r"newton:(velocityLimit|effortLimit|contact\w+|limit\w+|shellThickness)", Kind("number", endless=True)),
    (r"mjc:(actuatorfrcrange|range|\w+Range):(min|max)", Kind("number", endless=True)),
    (r"urdf:limit:\w+", Kind("number", endless=True)),
    (r"physics:(mass|density|dynamicFriction|staticFriction|restitution)", Kind("number")),
    (r"physics:gravityMagnitude", Kind("number", endless=True)),
    (r"drive:\w+:physics:(stiffness|damping|targetPosition|targetVelocity)", Kind("number")),
    (r"state:\w+:physics:(position|velocity)", Kind("number")),
    (r"physxJoint:(armature|jointFriction)", Kind("number")),
    (r"physxJointAxis:\w+:(armature|\w+FrictionEffort|viscousFrictionCoefficient)", Kind("number")),
    (r"physxMimicJoint:\w+:(gearing|offset|naturalFrequency|dampingRatio)", Kind("number")),
    (r"newton:(armature|friction|damping|mimicCoef\d|torsionalFriction|rollingFriction)", Kind("number")),
    (r"newton:maxHullVertices", Kind("number")),
    (r"urdf:dynamics:\w+", Kind("number")),
    (r"mjc:(armature|damping|frictionloss|stiffness|ref|springref|margin|gap|solmix)", Kind("number")),
    (r"mjc:(coef\d|inheritRange|width|torqueScale|group|condim|priority|crankLength)", Kind("number")),
    (r"mjc:(torsional|rolling)friction", Kind("number")),
    (r"mjc:(actDim|maxhullvert|body:gravcomp)", Kind("number")),
    (r"mjc:compiler:(boundMass|boundInertia|setTotalMass)", Kind("number")),
    (r"mjc:option:(impratio|density|viscosity|o_margin|noslip_\w+|timestep)", Kind("number")),
    (r"mjc:(flag:\w+|actEarly|actuatorgravcomp|jointInParent|compiler:(balanceInertia|autoLimits))", Kind("flag")),
    (r"physics:(\w+Enabled|excludeFromArticulation|invertFilteredGroups)", Kind("flag")),
    (r"physxRigidBody:disableGravity", Kind("flag")),
    (r"physxArticulation:(enabledSelfCollisions|articulationEnabled)", Kind("flag")),
    (r"newton:(\w+Enabled|jointsAddMobility)", Kind("flag")),
    (r"physics:(axis|approximation)", Kind("text")),
    (r"(drive:\w+:physics:type|physxMaterial:\w+CombineMode|physxMimicJoint:\w+:referenceJointAxis)", Kind("text")),
    (r"(newton:massModel|mjc:compiler:angle|physics:mergeGroup)", Kind("text")),
    (r"mjc:(type|gainType|biasType|dynType|inertia|\w*[lL]imited)", Kind("text")),
    (r"mjc:option:(cone|integrator|jacobian|solver)", Kind("text")),
    (r"physics:(diagonalInertia|localPos[01]|gravityDirection|velocity|angularVelocity)", Kind("vector", 3)),
    (r"physics:centerOfMass", Kind("vector", 3, endless=True)),
    (r"physics:(principalAxes|localRot[01])", Kind("vector", 4)),
    (r"newton:inertia", Kind("vector", 6)),
    (r"mjc:(gainPrm|biasPrm|dynPrm|gear|solref\w*|solimp\w*|springlength|springdamper|rgba)", Kind("array")),
    (r"mjc:(qpos|qvel|act|ctrl|mpos|mquat|option:(wind|magnetic|actuatorgroupdisable|o_\w+))", Kind("array")),
    (r"mjc:(path:(coef|divisors|indices|segments)|sideSites:indices)", Kind("array")),
)
_EXPECTED = {
    "number": "a number",
    "flag": "true or false",
    "text": "a token",
    "vector": "{length} numbers",
    "array": "an array of numbers",
}


@functools.cache
def kind_of(name: str) -> Kind | None:
    """Return what the attribute of this full name has to hold, None when any value will do."""
    return next((kind for pattern, kind in _KINDS if re.fullmatch(pattern, name)), None)


def value_of(attribute: Usd.Attribute, kind: Kind | None = None) -> Any:
    """Return an attribute's value as ``plain`` does, after holding it against what it has to be.

    Raises:
        AssetError: it is of another kind, not a number (NaN), or larger than anything a robot has.
    """
    value = plain(attribute.Get())
    if value is None:
        return None
    wrong = _wrong(value, kind)
    if wrong:
        raise _mistake(attribute, wrong, kind)
    return bool(value) if kind and kind.what == "flag" else value


def number_of(prim: Usd.Prim, name: str) -> float:
    """Return a shape's own number, such as ``radius``, the schema's where none is authored.

    Raises:
        AssetError: it is none, or infinite.
    """
    attribute = prim.GetAttribute(name)
    value = value_of(attribute, Kind("number")) if attribute else None
    if value is None:
        raise AssetError(f"'{name}' has no value", key=str(prim.GetPath()), expected="a number")
    return float(value)


def _wrong(value: Any, kind: Kind | None) -> str:
    """Return what is wrong with a value, nothing when it will do."""
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


def _mistake(attribute: Usd.Attribute, wrong: str, kind: Kind | None) -> AssetError:
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
    """Return the name of the layer that a value comes from."""
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
