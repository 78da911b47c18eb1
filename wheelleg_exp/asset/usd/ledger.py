"""Reads attributes and keeps account of them, so that nothing authored is passed over in silence."""

from __future__ import annotations

from typing import Any

from pxr import Sdf, Usd, UsdPhysics

from wheelleg_exp.asset.findings import Finding, Kind
from wheelleg_exp.asset.report import Assumption, LeftOut, Mapped
from wheelleg_exp.asset.usd.attributes import kind_of, value_of


class Ledger:
    """What was read and what it became, what was assumed, what was left out, and what people should know."""

    def __init__(self) -> None:
        self._mapped: dict[tuple[str, str], Mapped] = {}
        self._assumed: dict[tuple[str, str], Assumption] = {}
        self._left: dict[tuple[str, str], dict[str, str]] = {}
        self._left_names: set[tuple[str, str]] = set()
        self._warnings: dict[str, None] = {}
        self._found: dict[tuple[str, str, str], Finding] = {}
        self.authored: dict[str, dict[str, Any]] = {}  # attributes of joints in the file's units, by path and name

    def read(self, prim: Usd.Prim, name: str, became: str | None = None) -> Any:
        """Return an attribute's authored value in plain Python, or None.

        Args:
            prim: where it stands.
            name: full name, such as ``physics:mass``; of schemas that the USD library does not know as well.
            became: what it turns into; None when the caller says so later.

        Raises:
            AssetError: the value is no number where one belongs, NaN, or larger than anything a robot has.
        """
        attribute = prim.GetAttribute(name)
        if not attribute or not attribute.HasAuthoredValue():
            return None
        value = value_of(attribute, kind_of(name))
        if isinstance(value, (float, int, str)) and prim.IsA(UsdPhysics.Joint):
            self.authored.setdefault(str(prim.GetPath()), {})[name] = value
        if became and value is not None:
            self.mapped(prim.GetPath(), name, became)
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
        self._left_names.add((str(path), name))
        self._left.setdefault((name, reason), {})[str(path)] = str(value)

    def warn(self, text: str) -> None:
        """Note something that people should know."""
        self._warnings[text] = None

    def find(self, kind: Kind, subject: str, path: object, **numbers: float) -> None:
        """Record something odd, once for each kind, subject and place; what the numbers are stands in ``findings``."""
        self._found[kind, subject, str(path)] = Finding(
            kind, subject, str(path), {name: float(value) for name, value in numbers.items()}
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return everything odd, in the order of finding."""
        return tuple(self._found.values())

    def assumed(self, path: object, rule: str) -> bool:
        """Return whether a rule was followed somewhere."""
        return (str(path), rule) in self._assumed

    def knows(self, path: object, name: str) -> bool:
        """Return whether something is accounted for: it became something, or was left out for a reason."""
        key = (str(path), name)
        return key in self._mapped or key in self._left_names

    def left_out(self, path: object, name: str) -> bool:
        """Return whether something was left out for a reason."""
        return (str(path), name) in self._left_names

    def entries(
        self,
    ) -> tuple[tuple[Mapped, ...], tuple[Assumption, ...], tuple[LeftOut, ...], tuple[str, ...]]:
        """Return everything noted, in the order of noting."""
        left = tuple(LeftOut(name, reason, values) for (name, reason), values in self._left.items())
        mapped = tuple(item for key, item in self._mapped.items() if key not in self._left_names)
        return mapped, tuple(self._assumed.values()), left, tuple(self._warnings)
