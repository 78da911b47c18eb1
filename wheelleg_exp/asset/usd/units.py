"""Stage units to SI, y up to z up, and the values that mean "not given"."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.asset.geometry import Array, rounded

HUGE = 1e37  # from here on a number stands for infinity
ENDLESS_DEG = 5e7  # importers write a continuous hinge as ±57295776° (1e6 rad) or ±1e8°
ENDLESS_LENGTH = 1e6


@dataclass(frozen=True)
class Units:
    """Factors of one stage: metres per unit, kilograms per unit, and which axis is up."""

    meters: float
    kilograms: float
    up: str

    def world(self) -> Array:
        """Return the 4x4 map from stage coordinates to metres with z up (y up: +90° about x)."""
        out = np.eye(4)
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if self.up == "Y" else np.eye(3)
        out[:3, :3] = turn * self.meters
        return out

    def mass(self, value: float) -> float:
        """Return kg."""
        return value * self.kilograms

    def density(self, value: float) -> float:
        """Return kg/m³."""
        return value * self.kilograms / self.meters**3

    def inertia(self, value: float) -> float:
        """Return kg·m²."""
        return value * self.kilograms * self.meters**2

    def coordinate(self, value: float, angular: bool) -> float:
        """Return a joint coordinate or speed in rad or m, from degrees or stage lengths."""
        return rounded(math.radians(value) if angular else value * self.meters)

    def effort(self, value: float, angular: bool) -> float:
        """Return N·m or N."""
        return rounded(value * self.kilograms * self.meters ** (2 if angular else 1))

    def gain(self, value: float, angular: bool) -> float:
        """Return a stiffness or damping per rad or per m, from one per degree or per stage length."""
        if angular:
            return rounded(math.degrees(value) * self.kilograms * self.meters**2)
        return rounded(value * self.kilograms)

    def rotor(self, value: float, angular: bool) -> float:
        """Return an armature in kg·m² or kg."""
        return rounded(self.inertia(value) if angular else self.mass(value))


def given(value: float | None) -> bool:
    """Return whether a mass or density is given: authored and not zero."""
    return value is not None and value > 0 and math.isfinite(value)


def endless(value: float | None, angular: bool) -> bool:
    """Return whether a limit in degrees or stage lengths is none: absent, infinite or huge."""
    if value is None or not math.isfinite(value):
        return True
    return abs(value) >= (ENDLESS_DEG if angular else ENDLESS_LENGTH)


def effort_limit(value: float | None) -> float | None:
    """Return a drive's force limit in stage units, None for absent, infinite, huge and zero."""
    if value is None or not math.isfinite(value) or value >= HUGE or value <= 0:
        return None
    return value
