"""Makes the report of a conversion."""

from __future__ import annotations

from typing import Any

from wheelleg_exp.asset.description import RobotDescription
from wheelleg_exp.asset.report import DofOrder, Report
from wheelleg_exp.asset.usd.ledger import Ledger
from wheelleg_exp.asset.usd.stage import Stage


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
    mapped, assumed, left, warnings = ledger.entries()
    return Report(
        source=source,
        model=robot.name,
        root=root,
        base=base_of(robot),
        stage=stage,
        variants=variants,
        totals=totals(robot),
        bodies={body.path: body.name for body in robot.bodies},
        joints={dof.name: dof.path for dof in robot.dofs},
        dof_order=DofOrder(robot.breadth_first_dofs, tuple(dof.name for dof in robot.dofs)),
        velocity_limits={dof.name: dof.max_velocity for dof in robot.dofs if dof.max_velocity is not None},
        mapped=mapped,
        assumptions=assumed,
        left_out=left,
        warnings=warnings,
        unresolved=unresolved,
        findings=ledger.findings,
        layers=layers,
    )


def base_of(robot: RobotDescription) -> str:
    """Return how the roots stand in the world: floating, fixed, or attached by a joint."""
    roots = list(robot.children(None))
    kinds = {"floating" if body.floating else "attached" if body.dofs else "fixed" for body in roots}
    return ", ".join(sorted(kinds))


def totals(robot: RobotDescription) -> dict[str, float]:
    """Return the counts and the mass (kg) that tell at a glance whether a conversion is right."""
    return {
        "bodies": len(robot.bodies),
        "dofs": sum(3 if dof.kind == "ball" else 1 for dof in robot.dofs),
        "mass": round(robot.mass, 9),
        "colliders": len(robot.colliders),
        "visuals": sum(not geom.collides for body in robot.bodies for geom in body.geoms),
        "actuators": len(robot.actuators) + sum(dof.drive is not None for dof in robot.dofs),
    }
