"""What a conversion read, assumed and left out, as one typed document."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from wheelleg_exp.asset.findings import Finding, Verdict, verdict_of
from wheelleg_exp.reading import json_value

VERSION = 1


@dataclass(frozen=True)
class Mapped:
    """A part of the USD and what it became."""

    path: str
    name: str
    became: str


@dataclass(frozen=True)
class Assumption:
    """A value that the file does not give, or gives in a way that needs a rule."""

    path: str
    rule: str
    value: str


@dataclass(frozen=True)
class LeftOut:
    """Something that carries physics and has no place in the MJCF: ``values`` by prim path."""

    name: str
    reason: str
    values: dict[str, str]


@dataclass(frozen=True)
class DofOrder:
    """Names of the degrees of freedom in the order of either simulator."""

    physx: tuple[str, ...]
    mujoco: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """The whole story of one conversion.

    ``layers`` maps each layer that the stage is made of to the sha256 of its bytes. ``velocity_limits`` holds
    what MuJoCo has no place for and a controller still wants, in rad/s (m/s) by degree of freedom. ``findings`` are
    what is odd about the file, one record each; ``values`` are the model's numbers by name (``values_of``), and
    ``authored`` the file's own of its joints, by path, in its units.
    """

    source: str
    model: str
    root: str
    base: str
    stage: dict[str, Any]
    variants: dict[str, str]
    totals: dict[str, Any]
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
    values: dict[str, Any] = field(default_factory=dict)
    authored: dict[str, dict[str, Any]] = field(default_factory=dict)
    layers: dict[str, str] = field(default_factory=dict)
    version: int = VERSION

    @property
    def verdict(self) -> Verdict:
        """What the conversion is worth, by its findings and warnings."""
        return verdict_of(self.findings, self.totals.get("assumed_share", 0.0), len(self.warnings))

    def to_json(self) -> str:
        """Return one JSON document, the same to the byte for the same conversion."""
        return json.dumps({"verdict": asdict(self.verdict), **asdict(self)}, indent=2, ensure_ascii=False) + "\n"

    @staticmethod
    def from_json(text: str) -> Report:
        """Read a report back.

        Raises:
            ValueError: the text is no report of this version.
        """
        try:
            return _parse(json_value(text))
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"not a conversion report: {error}") from error


def _parse(data: Mapping[str, Any]) -> Report:
    if data["version"] != VERSION:
        raise ValueError(f"a report of version {data['version']}, expected {VERSION}")
    fields = {name: value for name, value in data.items() if name != "verdict"}  # which is made of the others
    fields["dof_order"] = DofOrder(tuple(data["dof_order"]["physx"]), tuple(data["dof_order"]["mujoco"]))
    fields["mapped"] = tuple(Mapped(**item) for item in data["mapped"])
    fields["assumptions"] = tuple(Assumption(**item) for item in data["assumptions"])
    fields["left_out"] = tuple(LeftOut(**item) for item in data["left_out"])
    fields["warnings"] = tuple(data["warnings"])
    fields["unresolved"] = tuple(data["unresolved"])
    fields["findings"] = tuple(Finding(**item) for item in data.get("findings", ()))  # of older reports: none
    return Report(**fields)
