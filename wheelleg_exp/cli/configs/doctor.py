"""``wheelleg doctor``: examine a robot as an expert would: what is wrong, how it is known, what to write."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import UsageError, add_config_dir, add_json, offer, print_json
from wheelleg_exp.cli.printing.terminal import hanging, print_blocks, print_table
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK
from wheelleg_exp.packages import with_current

if TYPE_CHECKING:
    from wheelleg_exp.lint.diagnosis import Diagnosis

_FILES = (".usd", ".usda", ".usdc", ".usdz", ".urdf", ".xml", ".mjcf", ".xacro")
_COLUMNS = ("", "", "place", "what", "write", "known by")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    text = "a USD, URDF or MJCF file; or task=… and other overrides"
    offer("robot", parser.add_argument("overrides", nargs="+", metavar="ROBOT|OVERRIDE", help=text))
    text = "write a picture: colliders, centre of mass, support, contacts"
    parser.add_argument("--screenshot", type=Path, metavar="FILE", help=text)
    parser.add_argument("--all", action="store_true", help="also show the findings that the task silences")
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the defects found in a robot model; return status 0 without defects, 1 with defects, 2 for wrong input."""
    if args.screenshot is not None:
        from wheelleg_exp.inspection.robot_picture import require_picture

        require_picture(args.screenshot)
    robot, *others = args.overrides
    if "=" not in robot and (Path(robot).suffix.lower() in _FILES or Path(robot).is_file()):
        from wheelleg_exp.lint.diagnosis import diagnose_file

        if others:
            expected = "a robot's file alone, or task=… with overrides"
            raise UsageError("one word too many", key=others[0], expected=expected)
        if set(args.config_dirs) - {*with_current([])}:
            message = "the option applies only to a task"
            raise UsageError(message, key="--config-dir", expected=f"'{robot}' alone, or task=…")
        found = diagnose_file(Path(robot))
    else:
        from wheelleg_exp.cli.configs.check import report_mistakes
        from wheelleg_exp.config.checking.find_mistakes import find_mistakes
        from wheelleg_exp.lint.diagnosis import diagnose_task

        composed, mistakes = find_mistakes(args.overrides, config_dirs=args.config_dirs)
        if mistakes:
            return report_mistakes(mistakes, as_json=args.json)
        assert composed is not None
        found = diagnose_task(composed)
    if args.screenshot is not None:
        from wheelleg_exp.inspection.robot_picture import write_picture

        assert found.case.robot is not None
        write_picture(found.case.robot, args.screenshot)
    if args.json:
        print_json(found.document())
    else:
        _show(found, show_all=args.all)
    return EXIT_FINDING if found.findings else EXIT_OK


def _show(found: Diagnosis, *, show_all: bool) -> None:
    from wheelleg_exp.lint.diagnosis import rows_of
    from wheelleg_exp.lint.physics_check import facts_rows

    print_table(("robot", "", ""), facts_rows(found.case.facts))
    print()
    for note in found.notes:
        print(hanging(note, 2, "- "))
    print()
    print_blocks(_COLUMNS, rows_of(found.findings), heads=2)
    if show_all and found.silenced:
        reasons = {finding.rule: reason for finding, reason in found.silenced}
        print_blocks((*_COLUMNS[:-1], "silenced"), rows_of([f for f, _ in found.silenced], reasons), heads=2)
    count, silent = len(found.findings), len(found.silenced)
    more = f", {silent} silenced{'' if show_all else ' (--all shows them)'}" if silent else ""
    print(f"{count} finding{'' if count == 1 else 's'}{more}")
    print(hanging(found.first, 2))
