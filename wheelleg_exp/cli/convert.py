"""``wheelleg convert``: a USD robot becomes an MJCF, with a report of what was read, assumed and left out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.common import add_json, print_table
from wheelleg_exp.errors import EXIT_OK, AssetError

if TYPE_CHECKING:
    from wheelleg_exp.asset import Conversion, Report

DESCRIPTION = "Convert a USD robot to MJCF: masses, joints, colliders, drives and visuals."
SHOWN = 15  # rows of a table before the rest is only counted


def add_parser(subparsers: Any) -> None:
    """Add the command to a script's subparsers."""
    configure(subparsers.add_parser("convert", help="convert a USD robot to MJCF", description=DESCRIPTION))


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("source", metavar="IN", type=Path, help="USD file (.usd, .usda, .usdc, .usdz)")
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help="MJCF file to write")
    parser.add_argument(
        "--base",
        choices=("auto", "floating", "fixed"),
        default="auto",
        help="auto: as authored; floating: drop the fixed joint to the world; fixed: no free joint",
    )
    parser.add_argument(
        "--variant",
        metavar="SET=NAME",
        action="append",
        default=[],
        help="choose a variant (may be repeated)",
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Convert, and print the report.

    Raises:
        AssetError: the source cannot be read or holds no robot, or the output cannot be written.
    """
    variants = dict(_variant(text) for text in args.variant)
    from wheelleg_exp.asset import convert

    conversion = convert(args.source, args.output, base=args.base, variants=variants)
    if args.json:
        sys.stdout.write(conversion.report.to_json())
    else:
        _show(conversion)
    return EXIT_OK


def _variant(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        expected = "SET=NAME, such as Physics=PhysX"
        raise AssetError(f"'{text}' chooses no variant", key="--variant", expected=expected)
    return name, value


def _show(conversion: Conversion) -> None:
    report = conversion.report
    print_table(("read", report.source), _summary(report), title=f"{report.source} to MJCF")
    assumed = [(item.path, item.rule, item.value) for item in report.assumptions]
    _section("Assumed", ("where", "rule", "value"), assumed)
    left = [(item.name, item.reason, _prims(item.values)) for item in report.left_out]
    _section("Left out", ("what", "why", "prims"), left)
    for warning in report.warnings:
        print(f"warning: {warning}")
    print(f"\nWrote {conversion.output}")
    print(f"Look at it: python -m mujoco.viewer --mjcf={conversion.output}")
    print("Train with it: name the USD as env.robot.asset; it is converted and cached by itself")


def _summary(report: Report) -> list[tuple[str, str]]:
    totals, stage = report.totals, report.stage
    return [
        ("model", f"{report.model}, {report.base} base"),
        ("bodies", f"{totals['bodies']}, {totals['mass']:.6g} kg in all"),
        ("degrees of freedom", f"{totals['dofs']}, of which {totals['actuators']} are driven"),
        ("order in PhysX", " ".join(report.dof_order.physx)),
        ("order in MuJoCo", " ".join(report.dof_order.mujoco)),
        ("shapes", f"{totals['colliders']} colliders, {totals['visuals']} visuals"),
        ("stage", f"{stage['metersPerUnit']:g} m, {stage['kilogramsPerUnit']:g} kg, {stage['upAxis']} up"),
        ("variants", ", ".join(f"{name}={value}" for name, value in report.variants.items()) or "none"),
        ("layers", ", ".join(report.layers)),
    ]


def _section(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    if not rows:
        return
    print(f"\n{title}")
    print_table(columns, rows[:SHOWN])
    if len(rows) > SHOWN:
        print(f"and {len(rows) - SHOWN} more; --json lists them all")


def _prims(values: dict[str, str]) -> str:
    path, value = next(iter(values.items()))
    more = f" and {len(values) - 1} more" if len(values) > 1 else ""
    return f"{path}{more}" + (f": {value}" if value else "")
