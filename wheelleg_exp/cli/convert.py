"""``wheelleg convert``: convert a USD or URDF robot to MJCF, and report what was read, assumed and left out."""

from __future__ import annotations

import argparse
import math
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import add_json
from wheelleg_exp.cli.printing.terminal import hanging, print_table, shown
from wheelleg_exp.definitions import percent
from wheelleg_exp.errors import EXIT_OK, AssetError, printable
from wheelleg_exp.stop_request import StopRequest

if TYPE_CHECKING:
    from wheelleg_exp.asset import Conversion, Report


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("source", metavar="IN", type=Path, help="USD (.usd, .usda, .usdc, .usdz) or URDF file")
    text = "MJCF file to write (.xml); next to it: the folder OUT's-stem_meshes, and OUT's-stem_scene.xml to view it"
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help=text)
    text = "auto: as authored; floating: drop the fixed joint to the world; fixed: no free joint"
    parser.add_argument("--base", choices=("auto", "floating", "fixed"), default="auto", help=text)
    text = "select a variant of a USD file instead of the authored one (repeatable)"
    parser.add_argument("--variant", metavar="SET=NAME", action="append", default=[], help=text)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Convert, and print the report."""
    variants = {}
    for text in args.variant:
        name, _, value = text.partition("=")
        if not (name and value):
            expected = "SET=NAME, such as Physics=PhysX"
            raise AssetError(f"'{text}' does not select a variant of a USD file", key="--variant", expected=expected)
        variants[name] = value
    with StopRequest() as stop:  # Without StopRequest, the import of the USD library ignores Ctrl-C.
        from wheelleg_exp.asset.convert_robot import convert
        from wheelleg_exp.asset.mjcf.preview_scene import write_scene
    stop.check()
    conversion = convert(args.source, args.output, base=args.base, variants=variants)
    scene = write_scene(conversion.description, conversion.output)
    if args.json:
        sys.stdout.write(conversion.report.to_json())
    else:
        show(conversion, scene)
    return EXIT_OK


ROWS = 15  # A printed table or list has at most 15 rows.
JOINTS = 40  # A robot's printed table has at most 40 joints.
WIDTH = 60  # A printed table cell has at most 60 characters.
NAMED = 6  # A list that is printed on one line has at most 6 names.
LOWER, UPPER = ("lowerLimit", "lower", "low"), ("upperLimit", "upper", "high")
VERDICTS = {"good": "converted without doubts", "check": "converted, check the result:", "doubtful": "DOUBTFUL:"}


def show(conversion: Conversion, scene: Path | None) -> None:
    """Print whether a converted robot is usable, and list warnings, joints, assumptions, and left-out items."""
    report = conversion.report
    count, reasons = len(report.warnings), list(report.verdict.reasons)
    if report.verdict.level == "check" and count:
        reasons.append("1 warning" if count == 1 else f"{count} warnings")
    verdict = f"{VERDICTS[report.verdict.level]} {'; '.join(reasons)}".strip()
    print(hanging(f"{printable(report.source)}: {verdict}", 4))
    groups = list(_grouped(report.warnings))
    for text in groups[:ROWS]:
        print(hanging(printable(text), 9, "warning:"))
    if len(groups) > ROWS:
        print(f"and {len(groups) - ROWS} more warnings; --json lists them all")
    print()
    for title, value in _summary(report):
        print(hanging(printable(value), 20, title))
    columns = ("joint", "kind", "range", "kp", "kv", "effort", "as authored")
    rows = list(_joints(conversion))
    used = [i for i, title in enumerate(columns) if title[0] != "k" or title == "kind" or any(row[i] for row in rows)]
    used = [i for i in used if columns[i] != "as authored" or any(row[i] for row in rows)]
    _section("Joints", [columns[i] for i in used], [[row[i] for i in used] for row in rows], JOINTS)
    order = report.dof_order  # The table has MuJoCo's joint order; print PhysX's order if it differs.
    if order.physx and order.physx != order.mujoco:
        print(hanging(f"order in PhysX: {_few(order.physx, JOINTS, ', ...')}", 4))
    # Print the values that the converter assumed because the robot file lacks them, and the joints or links affected.
    rules: dict[str, dict[str, str]] = {}
    for item in report.assumptions:
        rules.setdefault(item.rule, {})[item.path] = item.value
    rows = []
    for rule, values in rules.items():
        equal = len(set(values.values())) == 1
        first = next(iter(values.values()))
        rows.append((rule, _short(first) if equal else f"{_short(first)}, ...", _places(values)))
    _section("Assumed", ("rule", "value", "where"), rows)
    # Print what the converter left out of the robot file, and sort harmless omissions to the end.
    harmless = ("declared without", "a note of", "there is one")
    items = sorted(report.left_out, key=lambda item: item.reason.startswith(harmless))
    if names := list(dict.fromkeys(item.name for item in items)):
        print("\n" + hanging(printable(f"Left out: {_few(names)}; --json contains the reasons"), 4))
    output = shown(conversion.output.resolve())
    print(f"\nWrote {output}" + ("" if scene is None else f", and next to it {scene.name} with a floor and a light"))
    if report.base == "fixed":
        print("The base is fixed to the world: --base floating makes it move freely")
    viewed = output if scene is None else shown(scene.resolve())
    print(f"View it: python -m mujoco.viewer --mjcf={shlex.quote(str(viewed))}")
    print("Train with it: set env.robot.asset to the source, which is then converted and cached automatically")
    print("Every number, and the conversion of every attribute: the same command with --json")


def _summary(report: Report) -> list[tuple[str, str]]:
    totals, stage = report.totals, report.stage
    assumed = totals["assumed_mass"]
    share = "all of it from the file"
    if assumed:
        share = f"{assumed:.6g} kg ({percent(totals['assumed_share'])}) assumed"
    rows = [
        ("model", report.model),
        ("bodies", f"{totals['bodies']}, {totals['mass']:.6g} kg in all, {share}"),
        ("base", report.base),
        ("degrees of freedom", f"{totals['dofs']}, of which {totals['actuators']} are driven"),
        ("shapes", f"{totals['colliders']} colliders, {totals['visuals']} visuals"),
    ]
    if stage != {"metersPerUnit": 1.0, "kilogramsPerUnit": 1.0, "upAxis": "Z"} and "metersPerUnit" in stage:
        units = f"{stage['metersPerUnit']:g} m, {stage['kilogramsPerUnit']:g} kg, {stage['upAxis']} up"
        rows.append(("stage units", units))
    found = Counter(item.kind.replace("_", " ") for item in report.findings)
    if found:
        rows.append(("findings", ", ".join(f"{count} {kind}" for kind, count in found.items())))
    if report.variants:
        rows.append(("variants", ", ".join(f"{name}={value}" for name, value in report.variants.items())))
    layers = [name for name in report.layers if name != report.source]
    if layers:
        rows.append(("made of", f"{report.source}, {_few(layers)}"))
    return rows


def _few(names: Sequence[str], most: int = NAMED, more: str = "") -> str:
    return ", ".join(names[:most]) + ((more or f" and {len(names) - most} more") if len(names) > most else "")


def _joints(conversion: Conversion) -> Iterator[tuple[str, ...]]:
    """Yield a table row in SI units for each joint; add the robot file's original values if they differ."""
    report, robot = conversion.report, conversion.description
    # Find the joints that an actuator of the MJCF file drives.
    acting = {item.target: "actuator" for item in robot.actuators if item.transmission.startswith("joint")}
    for dof in robot.dofs:
        drive, (unit, unit_of_range) = dof.drive, ("N", "m") if dof.kind == "slide" else ("N m", "rad")
        effort = dof.effort
        force = "motor" if drive else acting.get(dof.name, "")
        limits = "unlimited"
        if dof.range is not None:
            limits = f"{dof.range[0]:.4g} to {dof.range[1]:.4g} {unit_of_range}"
        # Show a joint's limits and gains in the robot file's units if these values differ from the MJCF values.
        authored = report.authored.get(dof.path, {})
        by_end = {re.sub(r"^.*[:.]", "", name): value for name, value in authored.items()}
        low, high = (next((by_end[k] for k in keys if k in by_end), None) for keys in (LOWER, UPPER))
        usd = any(":" in name for name in authored)
        degrees = usd and dof.kind != "slide"
        parts = []
        endless = not any(isinstance(end, (int, float)) and math.isfinite(end) for end in (low, high))
        if low is not None and high is not None and not endless and (usd or dof.range is None):
            parts.append(f"{_shortly(low)} to {_shortly(high)}{' deg' if degrees else ''}")
        if degrees and dof.drive is not None:
            gains = [_shortly(by_end[key]) for key in ("stiffness", "damping") if by_end.get(key)]
            parts += [", ".join(gains) + " per deg"] if gains else []
        limit = None if dof.drive is None else dof.drive.effort
        most = by_end.get("maxForce")
        if limit is not None and isinstance(most, (int, float)) and not math.isclose(most, limit, rel_tol=1e-3):
            parts.append(f"max {_shortly(most)}")
        if not usd and dof.force_range is None and "effort" in by_end:
            parts.append(f"effort {_shortly(by_end['effort'])}")
        yield (
            dof.name,
            dof.kind,
            limits,
            f"{drive.stiffness:.4g}" if drive and drive.stiffness else "" if drive and drive.damping else force,
            f"{drive.damping:.4g}" if drive and drive.damping else "",
            "none" if effort is None else f"{effort:.4g} {unit}",
            "; ".join(parts),
        )


def _shortly(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, (int, float)) and math.isfinite(value) else str(value)


def _places(paths: Iterable[str]) -> str:
    first, *others = paths
    return first + (f" and {len(others)} more" if others else "")


def _short(text: str) -> str:
    return text if len(text) <= WIDTH else text[: WIDTH - 3] + "..."


def _grouped(warnings: Sequence[str]) -> Iterator[str]:
    """Merge conversion warnings whose texts differ only in file positions, names, and numbers."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for warning in warnings:
        path, colon, text = warning.partition(": ")
        place, text = (path, text) if colon and path.startswith("/") else ("", warning)
        groups.setdefault(re.sub(r"'[^']*'|(?<=without it: ).*|[-+]?\d[\d.e+-]*", "…", text), []).append((place, text))
    for found in groups.values():
        place, text = found[0]
        if place and all(other == text for _, other in found):
            yield f"{_places([where for where, _ in found])}: {text}"
        else:
            more = f" (and {len(found) - 1} more like this)" if len(found) > 1 else ""
            yield (f"{place}: " if place else "") + text + more


def _section(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], most: int = ROWS) -> None:
    if not rows:
        return
    print(f"\n{title}")
    print_table(columns, rows[:most])
    if len(rows) > most:
        print(f"and {len(rows) - most} more; --json lists them all")
