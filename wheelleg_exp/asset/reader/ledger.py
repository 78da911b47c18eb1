"""Reads attributes and keeps account of them, so that nothing authored is passed over in silence."""

from __future__ import annotations

from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd

from wheelleg_exp.asset.geometry import single
from wheelleg_exp.asset.report import Assumption, LeftOut, Mapped
from wheelleg_exp.errors import AssetError


class Ledger:
    """What was read and what it became, what was assumed, what was left out, and what people should know."""

    def __init__(self) -> None:
        self._mapped: dict[tuple[str, str], Mapped] = {}
        self._assumed: dict[tuple[str, str], Assumption] = {}
        self._left: dict[tuple[str, str], dict[str, str]] = {}
        self._warnings: dict[str, None] = {}

    def read(self, prim: Usd.Prim, name: str, became: str | None = None) -> Any:
        """Return an attribute's authored value in plain Python, or None.

        Args:
            prim: where it stands.
            name: full name, such as ``physics:mass``; of schemas that the USD library does not know as well.
            became: what it turns into; None when the caller says so later.

        Raises:
            AssetError: the value holds NaN.
        """
        attribute = prim.GetAttribute(name)
        if not attribute or not attribute.HasAuthoredValue():
            return None
        path = str(prim.GetPath())
        value = plain(attribute, path)
        if became and value is not None:
            self.mapped(path, name, became)
        return value

    def targets(self, prim: Usd.Prim, name: str, became: str | None = None) -> list[Sdf.Path]:
        """Return the targets of a relationship, [] when it is not authored."""
        relationship = prim.GetRelationship(name)
        if not relationship or not relationship.HasAuthoredTargets():
            return []
        if became:
            self.mapped(prim.GetPath(), name, became)
        return list(relationship.GetForwardedTargets())

    def mapped(self, path: object, name: str, became: str) -> None:
        """Note that something became something."""
        self._mapped[str(path), name] = Mapped(str(path), name, became)

    def assume(self, path: object, rule: str, value: object) -> None:
        """Note a value that comes from a rule and not from the file."""
        self._assumed[str(path), rule] = Assumption(str(path), rule, str(value))

    def leave(self, path: object, name: str, reason: str, value: object = "") -> None:
        """Note something that has no place in the model."""
        self._mapped.pop((str(path), name), None)
        self._left.setdefault((name, reason), {})[str(path)] = str(value)

    def warn(self, text: str) -> None:
        """Note something that people should know."""
        self._warnings[text] = None

    def knows(self, path: object, name: str) -> bool:
        """Return whether an attribute is accounted for: it became something, or was left out for a reason."""
        if (str(path), name) in self._mapped:
            return True
        return any(str(path) in values for (left, _), values in self._left.items() if left == name)

    def entries(
        self,
    ) -> tuple[tuple[Mapped, ...], tuple[Assumption, ...], tuple[LeftOut, ...], tuple[str, ...]]:
        """Return everything noted, in the order of noting."""
        left = tuple(LeftOut(name, reason, values) for (name, reason), values in self._left.items())
        return tuple(self._mapped.values()), tuple(self._assumed.values()), left, tuple(self._warnings)


def plain(attribute: Usd.Attribute, path: str) -> Any:
    """Return an attribute's value without USD types: numbers, text, tuples, quaternions (w, x, y, z), arrays.

    Raises:
        AssetError: the value holds NaN.
    """
    value = _convert(attribute.Get())
    if isinstance(value, (float, tuple, np.ndarray)) and _has_nan(value):
        raise AssetError(f"'{attribute.GetName()}' is not a number (NaN)", key=path, expected="finite numbers")
    return value


def _has_nan(value: Any) -> bool:
    array = np.asarray(value)
    return array.dtype.kind == "f" and bool(np.isnan(array).any())


def _convert(value: Any) -> Any:
    if isinstance(value, bool) or value is None or isinstance(value, (int, str)):
        return value
    if isinstance(value, float):
        return single(value) if float(np.float32(value)) == value else value
    if isinstance(value, (Gf.Quatf, Gf.Quatd, Gf.Quath)):
        return tuple(_convert(float(v)) for v in (value.GetReal(), *value.GetImaginary()))
    if isinstance(value, (Gf.Matrix3d, Gf.Matrix4d)):
        return np.array(value)
    if isinstance(value, Sdf.AssetPath):
        return value.path
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return value
    if array.ndim == 1 and array.size <= 6 and array.dtype.kind in "fi":
        return tuple(_convert(float(v)) for v in array)
    return array
