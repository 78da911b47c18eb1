"""``wheelleg convert``: convert a USD or URDF robot to MJCF, and report what was read, assumed and left out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from wheelleg_exp.cli.arguments import add_json
from wheelleg_exp.errors import EXIT_OK, AssetError
from wheelleg_exp.stop_request import StopRequest


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
        from wheelleg_exp.cli.printing.conversion_summary import show

        show(conversion, scene)
    return EXIT_OK
