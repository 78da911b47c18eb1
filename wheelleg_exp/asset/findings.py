"""What is odd about a robot's file, as data: one record for each thing found, for programs and for the report.

| kind | subject | numbers |
|---|---|---|
| `no_inertial` | body | ``mass`` that it got, kg: 0 for a frame on what it is welded to |
| `no_inertia` | body with a mass | ``mass`` kg; its tensor is that of its shapes, or of a sphere |
| `tiny_inertia` | body | ``mass`` kg, ``largest`` moment kg m² |
| `impossible_inertia` | body | ``a``, ``b``, ``c`` as written, ``cut_to`` the largest that a body can have, kg m² |
| `no_colliders` | robot | |
| `end_without_collider` | body that nothing hangs on | ``mass`` kg |
| `mesh_not_found` | file's name | ``colliders``, ``visuals`` that name it |
| `layer_not_found` | layer's name | |
| `limits_ignored` | joint that turns without end | ``lower``, ``upper`` as written |
| `no_limits` | joint that should have limits | ``lower``, ``upper`` as written, where they are |
| `placeholder_effort`, `placeholder_velocity` | joint | ``value`` as written: 0, or 1000 and more |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Kind = Literal[
    "no_inertial",
    "no_inertia",
    "tiny_inertia",
    "impossible_inertia",
    "no_colliders",
    "end_without_collider",
    "mesh_not_found",
    "layer_not_found",
    "limits_ignored",
    "no_limits",
    "placeholder_effort",
    "placeholder_velocity",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
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
