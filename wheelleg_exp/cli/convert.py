"""``wheelleg convert``: a USD or URDF robot becomes an MJCF, with a report of what was read, assumed and left out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from wheelleg_exp.cli.common import add_json
from wheelleg_exp.errors import EXIT_OK, AssetError
from wheelleg_exp.stop_request import StopRequest

DESCRIPTION = "Convert a USD or URDF robot to MJCF: masses, joints, colliders, drives and visuals."


def add_parser(subparsers: Any) -> None:
    """Add the command to a script's subparsers."""
    configure(subparsers.add_parser("convert", help="convert a robot file to MJCF", description=DESCRIPTION))


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("source", metavar="IN", type=Path, help="USD (.usd, .usda, .usdc, .usdz) or URDF file")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=Path,
        required=True,
        help="MJCF file to write (.xml); beside it: the folder OUT's-stem_meshes, and OUT's-stem_scene.xml to look at",
    )
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
        help="choose a variant of a USD file in place of the authored one (may be repeated)",
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Convert, and print the report.

    Raises:
        AssetError: the source cannot be read or holds no robot, or the output cannot be written.
    """
    variants = dict(_variant(text) for text in args.variant)
    with StopRequest() as stop:  # the USD library swallows an interrupt of its import
        from wheelleg_exp.asset.convert_robot import convert
        from wheelleg_exp.asset.mjcf.preview_scene import write_scene
    stop.check()
    conversion = convert(args.source, args.output, base=args.base, variants=variants)
    scene = write_scene(conversion.description, conversion.output)
    if args.json:
        sys.stdout.write(conversion.report.to_json())
    else:
        from wheelleg_exp.cli.printing.conversion_summary import show

        show(conversion, scene)
    return EXIT_OK


def _variant(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        expected = "SET=NAME, such as Physics=PhysX"
        raise AssetError(f"'{text}' chooses no variant", key="--variant", expected=expected)
    return name, value
