"""The report of a conversion: what was read, assumed, and left out; the findings, the verdict, and the model's values.

| kind of finding | subject | numbers |
|---|---|---|
| `no_inertial` | body | assumed ``mass``, kg; 0 for a frame on the body that it is welded to |
| `no_inertia` | body with a mass | ``mass`` kg; ``computed`` 1 for the tensor of its shapes, else that of a sphere |
| `tiny_inertia` | body | ``mass`` kg, ``largest`` moment kg m² |
| `impossible_inertia` | body | ``a``, ``b``, ``c`` as written, ``cut_to`` the largest possible moment, kg m² |
| `no_colliders` | robot | |
| `implausible_size` | robot | ``mass`` kg, ``size`` m: longest edge of the box around its colliders and joints |
| `end_without_collider` | last body of a limb | ``mass`` kg |
| `mesh_not_found` | file name | ``colliders``, ``visuals`` that name it |
| `layer_not_found` | layer name | ``places`` that name it; ``looks`` 1 when all of them are only visual |
| `limits_ignored` | continuous joint | ``lower``, ``upper`` as written |
| `no_limits` | joint that should have limits | ``lower``, ``upper`` as written, where given |
| `placeholder_effort`, `placeholder_velocity` | joint | ``value`` as written: 0, or at least 1000 |
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Literal, get_args

from wheelleg_exp.plain_data import json_value

Kind = Literal[
    "no_inertial", "no_inertia", "tiny_inertia", "impossible_inertia", "no_colliders", "implausible_size",
    "end_without_collider", "mesh_not_found", "layer_not_found", "limits_ignored", "no_limits", "placeholder_effort",
    "placeholder_velocity",
]  # fmt: skip
KINDS: tuple[Kind, ...] = get_args(Kind)
UNITS = "check the units: metres and kilograms; meshes in mm need a scale of 0.001"
SIZES = (0.01, 20.0)  # m
DENSITIES = (0.01, 5000.0)  # kg/m³
PLACEHOLDER = 1e3  # SI units


@dataclass(frozen=True)
class Finding:
    """One finding: its kind, the name of the body, joint, or file, and its path in the source."""

    kind: Kind
    subject: str
    path: str
    numbers: dict[str, float]


def is_placeholder(value: float) -> bool:
    """Return whether an effort or velocity limit is a placeholder: next to zero, or too large for any motor."""
    return abs(value) < 1e-6 or abs(value) >= PLACEHOLDER


def size_problem(mass: float, size: float, lightest: float = DENSITIES[0]) -> str:
    """Return why a robot's mass (kg) and longest edge (m) are implausible; an empty string if they are plausible.

    ``lightest`` (kg/m³) is the smallest plausible density: the robot's mass divided by the cube of its longest edge.
    """
    density = mass / size**3 if size > 0 else math.nan
    if not lightest <= density <= DENSITIES[1]:
        return f"{mass:.4g} kg in {size:.4g} m: a cube of that size would weigh {density:.3g} kg/m³"
    return "" if SIZES[0] <= size <= SIZES[1] else f"the robot is {size:.4g} m long"


@dataclass(frozen=True)
class Verdict:
    """How well a robot file was converted; at the level ``check``, the user should read the conversion's warnings."""

    level: Literal["good", "check", "doubtful"]
    reasons: tuple[str, ...] = ()


MUCH = 0.1  # share of the mass


def verdict_of(findings: Sequence[Finding], assumed_share: float, warnings: int) -> Verdict:
    """Rate a conversion; ``assumed_share`` is the share (0 to 1) of the robot's mass that the converter assumed."""
    count = Counter(item.kind for item in findings)
    gone = sum(item.kind == "layer_not_found" and not item.numbers["looks"] for item in findings)
    lost = sum(item.numbers.get("colliders", 0) for item in findings if item.kind == "mesh_not_found")
    doubts = [
        (count["no_colliders"], "the robot has no colliders"),
        (count["implausible_size"], "no robot has this size and mass"),
        (assumed_share >= MUCH, f"{assumed_share:.0%} of the mass is assumed"),
        (lost, f"{lost:g} colliders are lost with their mesh files"),
        (gone, f"{gone} layers or prims that the file names are missing"),
        (count["limits_ignored"], f"{count['limits_ignored']} joints lost the limits that the file writes"),
    ]
    reasons = tuple(text for true, text in doubts if true)
    if not reasons and assumed_share:
        return Verdict("check", (f"{assumed_share:.1%} of the mass is assumed",))
    return Verdict("doubtful" if reasons else "check" if warnings else "good", reasons)


VERSION = 1


@dataclass(frozen=True)
class Mapped:
    """An element of the robot file, and the MJCF element that replaces it."""

    path: str
    name: str
    became: str


@dataclass(frozen=True)
class Assumption:
    """A value that a rule of the converter chose, because the robot file lacks the value or is ambiguous."""

    path: str
    rule: str
    value: str


@dataclass(frozen=True)
class LeftOut:
    """Physics of the file that has no place in the MJCF: ``values`` by prim path."""

    name: str
    reason: str
    values: dict[str, str]


@dataclass(frozen=True)
class DofOrder:
    """Names of the robot's degrees of freedom, in PhysX's and in MuJoCo's order."""

    physx: tuple[str, ...]
    mujoco: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """The report of one conversion.

    ``layers`` maps source files to sha256. ``velocity_limits``, rad/s (m/s), are only here, because MJCF cannot contain
    them. ``values`` are the converted numbers, and ``authored`` the original ones by joint path, in the file's units.
    """

    source: str
    model: str
    root: str
    base: str
    stage: dict[str, float | str]
    variants: dict[str, str]
    totals: dict[str, float]
    bodies: dict[str, str]
    joints: dict[str, str]
    dof_order: DofOrder
    velocity_limits: dict[str, float]
    mapped: tuple[Mapped, ...] = ()
    assumptions: tuple[Assumption, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    warnings: tuple[str, ...] = ()
    unresolved: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    values: dict[str, object] = field(default_factory=dict)
    authored: dict[str, dict[str, object]] = field(default_factory=dict)
    layers: dict[str, str] = field(default_factory=dict)
    version: int = VERSION

    @property
    def verdict(self) -> Verdict:
        """How well the robot file was converted, judged by missing or implausible parts and by warnings."""
        return verdict_of(self.findings, self.totals.get("assumed_share", 0.0), len(self.warnings))

    def to_json(self) -> str:
        """Return the report as JSON. Equal conversions give byte-identical JSON."""
        return json.dumps({"verdict": asdict(self.verdict), **asdict(self)}, indent=2, ensure_ascii=False) + "\n"

    @staticmethod
    def from_json(text: str) -> Report:
        try:
            data = json_value(text)
            if data["version"] != VERSION:
                raise ValueError(f"the conversion report has version {data['version']}, expected {VERSION}")
            fields = {name: value for name, value in data.items() if name != "verdict"}  # a computed property
            fields["dof_order"] = DofOrder(tuple(data["dof_order"]["physx"]), tuple(data["dof_order"]["mujoco"]))
            fields["mapped"] = tuple(Mapped(**item) for item in data["mapped"])
            fields["assumptions"] = tuple(Assumption(**item) for item in data["assumptions"])
            fields["left_out"] = tuple(LeftOut(**item) for item in data["left_out"])
            fields["warnings"], fields["unresolved"] = tuple(data["warnings"]), tuple(data["unresolved"])
            fields["findings"] = tuple(Finding(**item) for item in data.get("findings", ()))
            return Report(**fields)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"a field of the conversion report is missing or invalid: {error}") from error
