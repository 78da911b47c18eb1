"""Makes the report of a conversion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from wheelleg_exp.asset.description import RobotDescription
from wheelleg_exp.asset.findings import Finding
from wheelleg_exp.asset.report import DofOrder, Report
from wheelleg_exp.asset.shape_findings import note_colliders
from wheelleg_exp.asset.usd.ledger import Ledger
from wheelleg_exp.asset.usd.stage import Stage
from wheelleg_exp.asset.values import plain


def summarise(stage: Stage, robot: RobotDescription) -> Report:
    """Return the report of a stage and the robot read from it."""
    units = stage.units
    return report_of(
        robot,
        stage.ledger,
        source=stage.source.name,
        root=str(stage.root.GetPath()),
        stage={"metersPerUnit": units.meters, "kilogramsPerUnit": units.kilograms, "upAxis": str(units.up)},
        variants=stage.variants,
        unresolved=stage.unresolved,
        layers=stage.layers,
    )


def report_of(
    robot: RobotDescription,
    ledger: Ledger,
    *,
    source: str,
    root: str,
    stage: dict[str, Any],
    variants: dict[str, str],
    unresolved: tuple[str, ...],
    layers: dict[str, str],
) -> Report:
    """Return the report of a robot, of whatever format its file is.

    Args:
        robot: what was read.
        ledger: what was noted on the way.
        source: the file's name.
        root: path of the robot within the file.
        stage: the file's units.
        variants: names in force by variant set.
        unresolved: names of files that are not there.
        layers: sha256 of each file that was read.
    """
    note_colliders(robot, ledger)
    findings = _by_name(robot, ledger)
    mapped, assumed, left, warnings = ledger.entries()
    return Report(
        source=source,
        model=robot.name,
        root=root,
        base=base_of(robot),
        stage=stage,
        variants=variants,
        totals=totals(robot, findings),
        bodies={body.path: body.name for body in robot.bodies},
        joints={dof.name: dof.path for dof in robot.dofs},
        dof_order=DofOrder(robot.breadth_first_dofs, tuple(dof.name for dof in robot.dofs)),
        velocity_limits={dof.name: dof.max_velocity for dof in robot.dofs if dof.max_velocity is not None},
        mapped=mapped,
        assumptions=assumed,
        left_out=left,
        warnings=warnings,
        unresolved=unresolved,
        findings=findings,
        authored=plain(ledger.authored),
        layers=layers,
    )


def _by_name(robot: RobotDescription, ledger: Ledger) -> tuple[Finding, ...]:
    """Return the findings, those of bodies and joints by the names that these have in the model."""
    names: dict[str, str] = {}
    for path, name in [(b.path, b.name) for b in robot.bodies] + [(d.path, d.name) for d in robot.dofs]:
        names.setdefault(path, name)
    return tuple(
        item if item.kind.endswith("_not_found") else replace(item, subject=names.get(item.path, item.subject))
        for item in ledger.findings
    )


def base_of(robot: RobotDescription) -> str:
    """Return how the roots stand in the world: floating, fixed, or attached by a joint."""
    roots = list(robot.children(None))
    kinds = {"floating" if body.floating else "attached" if body.dofs else "fixed" for body in roots}
    return ", ".join(sorted(kinds))


def totals(robot: RobotDescription, findings: Iterable[Finding]) -> dict[str, float]:
    """Return the counts and masses (kg) that tell at a glance whether a conversion is right."""
    assumed = sum(item.numbers["mass"] for item in findings if item.kind == "no_inertial")
    return {
        "bodies": len(robot.bodies),
        "dofs": sum(3 if dof.kind == "ball" else 1 for dof in robot.dofs),
        "mass": round(robot.mass, 9),
        "assumed_mass": round(assumed, 9),
        "assumed_share": round(assumed / robot.mass, 6) if robot.mass > 0 else 0.0,
        "colliders": len(robot.colliders),
        "visuals": sum(not geom.collides for body in robot.bodies for geom in body.geoms),
        "actuators": len(robot.actuators) + sum(dof.drive is not None for dof in robot.dofs),
    }
