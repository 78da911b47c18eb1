"""What is odd about a robot's file, as data: one record for each thing found, for programs and for the report.

| kind | subject | numbers |
|---|---|---|
| `no_inertial` | body | ``mass`` that it got, kg: 0 for a frame on what it is welded to |
| `no_inertia` | body with a mass | ``mass`` kg; its tensor is that of its shapes, or of a sphere |
| `tiny_inertia` | body | ``mass`` kg, ``largest`` moment kg m² |
| `impossible_inertia` | body | ``a``, ``b``, ``c`` as written, ``cut_to`` the largest that a body can have, kg m² |
| `no_colliders` | robot | |
| `implausible_size` | robot | ``mass`` kg, ``size`` m: longest edge of the box around its colliders and joints |
| `end_without_collider` | body that nothing hangs on | ``mass`` kg |
| `mesh_not_found` | file's name | ``colliders``, ``visuals`` that name it |
| `layer_not_found` | layer's name | ``places`` that name it; ``looks`` 1 when all are for looks |
| `limits_ignored` | joint that turns without end | ``lower``, ``upper`` as written |
| `no_limits` | joint that should have limits | ``lower``, ``upper`` as written, where they are |
| `placeholder_effort`, `placeholder_velocity` | joint | ``value`` as written: 0, or 1000 and more |
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Kind = Literal[
    "no_inertial",
    "no_inertia",
    "tiny_inertia",
    "impossible_inertia",
    "no_colliders",
    "implausible_size",
    "end_without_collider",
    "mesh_not_found",
    "layer_not_found",
    "limits_ignored",
    "no_limits",
    "placeholder_effort",
    "placeholder_velocity",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
UNITS = "check the units: metres and kilograms; meshes in mm need a scale of 0.001"
SIZES = (0.01, 20.0)  # m, longest edge of a robot
DENSITIES = (0.01, 5000.0)  # kg/m³ of a cube whose edge is the robot's longest; most real robots have 10 to 100
PLACEHOLDER = 1e3  # N m, N, rad/s or m/s: from here on a limit is what an exporter writes for "none"


@dataclass(frozen=True)
class Finding:
    """One thing found: what it is, the body, joint or file that it is about by name, and where it stands."""

    kind: Kind
    subject: str
    path: str
    numbers: dict[str, float]


def is_placeholder(value: float) -> bool:
    """Return whether a limit of effort or speed is no limit of any motor: zero, or huge."""
    return value == 0 or abs(value) >= PLACEHOLDER


def size_problem(mass: float, size: float, lightest: float = DENSITIES[0]) -> str:
    """Return why no robot has this mass (kg) and longest edge (m); an empty text if the pair is plausible.

    ``lightest`` is the smallest density in kg/m³ of a cube with that edge.
    """
    density = mass / size**3 if size > 0 else math.nan
    if not lightest <= density <= DENSITIES[1]:
        return f"{mass:.4g} kg in {size:.4g} m: a cube of that size would weigh {density:.3g} kg/m³"
    return "" if SIZES[0] <= size <= SIZES[1] else f"the robot is {size:.4g} m long"


@dataclass(frozen=True)
class Verdict:
    """What a conversion is worth: ``good``, ``check`` (read the warnings) or ``doubtful``, and further ``reasons``."""

    level: Literal["good", "check", "doubtful"]
    reasons: tuple[str, ...] = ()


MUCH = 0.1  # share of the mass that is assumed, from which on a robot is not the one that was meant


def verdict_of(findings: Sequence[Finding], assumed_share: float, warnings: int) -> Verdict:
    """Return the verdict on a conversion.

    Args:
        findings: what is odd about the file.
        assumed_share: how much of the mass the file does not give.
        warnings: how many there are.
    """
    count = Counter(item.kind for item in findings)
    gone = sum(item.kind == "layer_not_found" and not item.numbers["looks"] for item in findings)
    lost = sum(item.numbers.get("colliders", 0) for item in findings if item.kind == "mesh_not_found")
    doubts = [
        (count["no_colliders"], "it has no colliders"),
        (count["implausible_size"], "no robot has its size and mass"),
        (assumed_share >= MUCH, f"{assumed_share:.0%} of its mass is assumed"),
        (lost, f"{lost:g} colliders are lost with their meshes"),
        (gone, f"{gone} layers or prims that it names are not there"),
        (count["limits_ignored"], f"{count['limits_ignored']} joints lost the limits that are written"),
    ]
    reasons = tuple(text for true, text in doubts if true)
    if not reasons and assumed_share:
        return Verdict("check", (f"{assumed_share:.1%} of its mass is assumed",))
    return Verdict("doubtful" if reasons else "check" if warnings else "good", reasons)
