"""``wheelleg identify LOG --robot R``: identify motor parameters from a log of chirps, and write a robot profile."""

from __future__ import annotations

import argparse
import copy
import re
import sys
from pathlib import Path

from wheelleg_exp.cli.arguments import UsageError, add_config_dir, add_json, print_json
from wheelleg_exp.cli.printing.terminal import print_table, shown, styled
from wheelleg_exp.errors import EXIT_OK


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("log", metavar="LOG", type=Path, help="a log of the bundle's chirps.py: .csv, .parquet, .mcap")
    parser.add_argument("--robot", metavar="R", required=True, help="the robot config to start from, such as physical")
    text = "the robot profile to write (default: <R>_identified.yaml)"
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help=text)
    text = "a weight on a wheel, kg and m from the axle: l03=0.05,0.015 (repeatable); it hangs below the axle at 0 rad"
    parser.add_argument("--weight", action="append", default=[], metavar="JOINT=KG,M", help=text)
    text = "the rate at which the robot's drives compute their torques (default: 1000)"
    parser.add_argument("--drive-rate", type=float, default=1000.0, metavar="HZ", help=text)
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Identify the motors, print the parameters and the prediction errors, and write the profile."""
    weights = dict(map(_weight, args.weight))
    output = args.output or Path(f"{args.robot}_identified.yaml")
    if not re.fullmatch(r"(?!null|true|false|yes|no|on|off)[A-Za-z][\w-]*\.yaml", output.name):
        raise UsageError(f"'{output.name}' is not a name of a profile", key="-o", expected="such as my_robot.yaml")
    if not 1 <= args.drive_rate <= 1e5:
        raise UsageError(f"{args.drive_rate:g} is not a rate of drives", key="--drive-rate", expected="1 to 100000 Hz")

    from wheelleg_exp.build import prepare_asset
    from wheelleg_exp.config.composing.compose import compose
    from wheelleg_exp.files import require_new, write_new
    from wheelleg_exp.robot_logs.motor_identification import UNITS, identify, profile_text
    from wheelleg_exp.robot_logs.robot_log import read_log

    require_new(output)
    log = read_log(args.log)
    if not log.is_checked:
        print(f"note: {shown(args.log)} contains no checksums, so that damage cannot be noticed", file=sys.stderr)
    composed = compose([f"robot={args.robot}"], config_dirs=args.config_dirs)
    config = copy.deepcopy(dict(composed.config))
    config["env"]["robot"]["base"] = "fixed"
    mjcf = prepare_asset(config, composed.asset_roots).output

    def progress(line: str) -> None:
        if sys.stderr.isatty():
            styled(sys.stderr).write(f"\r{line}  ")

    found = identify(log, config["env"], mjcf, weights, args.drive_rate, progress)
    text = profile_text(found, args.robot, output.stem, args.log.name)
    write_new(output, text.encode())
    if args.json:
        errors = {"fitted": found.fitted, "held_out": found.held_out, "pieces": found.pieces}
        print_json({"profile": str(output), "parameters": [vars(p) for p in found.parameters], **errors})
        return EXIT_OK
    rows = [
        (p.joint, p.name, f"{p.before:.4g}", f"{p.value:.4g}", f"{p.low:.4g} to {p.high:.4g}", UNITS[p.name])
        for p in found.parameters
    ]
    print_table(("joint", "parameter", args.robot, "identified", "95 % interval", "unit"), rows)
    scores = (found.fitted, found.held_out)
    for what, (before, after), count in zip(("fitted", "held-out"), scores, found.pieces, strict=True):
        print(f"prediction error on {count} {what} chirps: {before:.3g} times the noise before, {after:.3g} after")
    print(f"wrote {shown(output)}")
    return EXIT_OK


def _weight(text: str) -> tuple[str, tuple[float, float]]:
    name, _, numbers = text.partition("=")
    try:
        mass, radius = map(float, numbers.split(","))
    except ValueError:
        mass = radius = 0.0
    if not (name and 0 < mass < 100 and 0 < radius < 10):
        raise UsageError(f"'{text}' is not a weight", key="--weight", expected="JOINT=KG,M, such as l03=0.05,0.015")
    return name, (mass, radius)
