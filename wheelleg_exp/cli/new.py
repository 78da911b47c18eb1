"""``wheelleg new NAME``: create a user project with a robot, a task, a term and a test."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from wheelleg_exp.cli.arguments import add_json, print_json
from wheelleg_exp.errors import EXIT_OK


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("place", metavar="NAME", type=Path, help="the project's name, or a new folder that ends in it")
    text = "a USD or URDF file, or a name of the package robot_descriptions (default: the stock robot)"
    parser.add_argument("--robot", metavar="FILE", type=Path, help=text)
    text = "create the project although colliders or wheels of the robot are missing"
    parser.add_argument("--allow-missing", action="store_true", help=text)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Create a user project, and print the project's contents and suggested next commands. An error leaves no files."""
    from wheelleg_exp.stop_request import StopRequest

    with StopRequest() as stop:  # Without StopRequest, the import of the USD library ignores Ctrl-C.
        from wheelleg_exp.project.create import create
    stop.check()
    made = create(args.place, args.robot, allow_missing=args.allow_missing)
    robot, facts = made.robot, made.robot.facts
    shown = os.path.relpath(made.path)
    if args.json:
        found = {"mass_kg": facts.mass, "standing_height_m": facts.standing_height, "legs": robot.legs}
        found |= {"held": robot.held, "wheels": robot.wheels, "notes": robot.notes, "accepted": made.accepted}
        files = sorted(os.path.relpath(file, made.path) for file in made.files)
        print_json({"project": shown, "robot": made.path.name, **found, "files": files})
        return EXIT_OK
    print(f"created {shown}: {len(made.files)} files")
    which = "the stock robot (no --robot was given), " if args.robot is None else ""
    print(f"  robot: {which}{facts.mass:.4g} kg, {1e3 * facts.standing_height:.4g} mm high in its default pose")
    print(f"  legs: {', '.join(robot.legs) or 'none'}")
    if robot.held:
        print(f"  held still: {', '.join(robot.held)}")
    print(f"  wheels: {', '.join(robot.wheels) or 'none'}")
    for note in robot.notes:
        print(f"  note: {note}")
    for rule, text in made.accepted.items():
        print(f"  accepted as a property of the robot ({rule}): {text}")
    name = made.path.name
    print(f"next: cd {shown}")
    print(f"      wheelleg train pipeline=first_drive robot={name}    # learns to drive")
    print("      wheelleg play latest --drive                        # drive it in the browser")
    print("      README.md explains more; nothing has to be installed")
    return EXIT_OK
