"""How ``wheelleg convert`` tells people what came of a robot file: readable for two joints and for three thousand."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from wheelleg_exp.cli.printing.figures import shown
from wheelleg_exp.cli.printing.tables import print_table
from wheelleg_exp.errors import printable

if TYPE_CHECKING:
    from wheelleg_exp.asset import Conversion, Report
    from wheelleg_exp.asset.description import Dof, RobotDescription
    from wheelleg_exp.asset.report import LeftOut

ROWS = 15  # of a table, before the rest is only counted
JOINTS = 40
WIDTH = 60  # characters of a cell


def show(conversion: Conversion) -> None:
    """Print the summary, the joints, what was assumed and left out, warnings, and what to do next."""
    report = conversion.report
    print_table(("read", printable(report.source)), _summary(report))
    _section("Joints", ("joint", "kind", "range", "drive", "PhysX", "MuJoCo"), _joints(conversion), JOINTS)
    _section("Assumed", ("rule", "value", "where"), _assumed(report))
    left = [(item.name, item.reason, _prims(item.values)) for item in sorted(report.left_out, key=_is_note)]
    _section("Left out", ("what", "why", "prims"), left)
    if report.warnings:
        print()
    for text in _grouped(report.warnings):
        print(f"warning: {printable(text)}")
    output = shown(conversion.output.resolve())
    print(f"\nWrote {output}")
    if report.base == "fixed":
        print("Its base is fixed to the world: --base floating lets it move")
    print(f"Look at it: python -m mujoco.viewer --mjcf={shlex.quote(str(output))}")
    print("Train with it: name the source as env.robot.asset; it is converted and cached by itself")
    print("What became of every attribute: the same command with --json")


def _summary(report: Report) -> list[tuple[str, str]]:
    totals, stage = report.totals, report.stage
    rows = [
        ("model", f"{report.model}, {report.base} base"),
        ("bodies", f"{totals['bodies']}, {totals['mass']:.6g} kg in all"),
        ("degrees of freedom", f"{totals['dofs']}, of which {totals['actuators']} are driven"),
        ("shapes", f"{totals['colliders']} colliders, {totals['visuals']} visuals"),
    ]
    if "metersPerUnit" in stage:
        units = f"{stage['metersPerUnit']:g} m, {stage['kilogramsPerUnit']:g} kg, {stage['upAxis']} up"
        rows.append(("stage units", units))
    if report.variants:
        rows.append(("variants", ", ".join(f"{name}={value}" for name, value in report.variants.items())))
    layers = list(report.layers)
    rows += [("layers" if i == 0 else "", name) for i, name in enumerate(layers[:ROWS])]
    if len(layers) > ROWS:
        rows.append(("", f"and {len(layers) - ROWS} more"))
    return rows


def _joints(conversion: Conversion) -> list[tuple[str, ...]]:
    """Return a row for each degree of freedom in MuJoCo's order, with its place in either simulator's order."""
    physx = {name: str(place) for place, name in enumerate(conversion.report.dof_order.physx)}
    driven = _driven(conversion.description)
    return [
        (dof.name, dof.kind, _range(dof), driven.get(dof.name, "none"), physx.get(dof.name, "-"), str(place))
        for place, dof in enumerate(conversion.description.dofs)
    ]


def _range(dof: Dof) -> str:
    if dof.range is None:
        return "unlimited"
    low, high = dof.range
    if dof.kind == "slide":
        return f"{low:.4g} to {high:.4g} m"
    return f"{math.degrees(low):.4g} to {math.degrees(high):.4g} deg"


def _driven(robot: RobotDescription) -> dict[str, str]:
    """Return what drives each joint, by the joint's name."""
    out = {item.target: "actuator" for item in robot.actuators if item.transmission.startswith("joint")}
    for dof in robot.dofs:
        if dof.drive is not None:
            gains = {"position": f" kp {dof.drive.stiffness:.4g}", "motor": "", "velocity": ""}[dof.drive.kind]
            gains += f" kv {dof.drive.damping:.4g}" if dof.drive.damping else ""
            limit = "" if dof.drive.effort is None else f", at most {dof.drive.effort:.4g}"
            out[dof.name] = f"{dof.drive.kind}{gains}{limit}"
    return out


def _assumed(report: Report) -> list[tuple[str, str, str]]:
    """Return a row for each rule: its value where all are equal, and where it was used."""
    rules: dict[str, dict[str, str]] = {}
    for item in report.assumptions:
        rules.setdefault(item.rule, {})[item.path] = item.value
    rows = []
    for rule, values in rules.items():
        equal = len(set(values.values())) == 1
        first = next(iter(values.values()))
        rows.append((rule, _short(first) if equal else f"{_short(first)}, ...", _places(values)))
    return rows


def _is_note(item: LeftOut) -> bool:
    """Return whether what was left out says nothing of how the robot moves; such rows come last."""
    return item.reason.startswith(("declared without", "a note of", "there is one"))


def _places(paths: Iterable[str]) -> str:
    first, *others = paths
    return first + (f" and {len(others)} more" if others else "")


def _prims(values: dict[str, str]) -> str:
    value = _short(next(iter(values.values())))
    return _places(values) + (f": {value}" if value else "")


def _short(text: str) -> str:
    return text if len(text) <= WIDTH else text[: WIDTH - 3] + "..."


def _grouped(warnings: Sequence[str]) -> list[str]:
    """Return the warnings; those that say the same of several prims are one."""
    groups: dict[str, list[str]] = {}
    for text in warnings:
        path, colon, said = text.partition(": ")
        at_prim = bool(colon) and path.startswith("/")
        groups.setdefault(said if at_prim else text, []).extend([path] if at_prim else [])
    return [f"{_places(paths)}: {text}" if paths else text for text, paths in groups.items()]


def _section(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], most: int = ROWS) -> None:
    if not rows:
        return
    print(f"\n{title}")
    print_table(columns, rows[:most])
    if len(rows) > most:
        print(f"and {len(rows) - most} more; --json lists them all")
