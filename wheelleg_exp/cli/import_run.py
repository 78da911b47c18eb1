"""``wheelleg import RUN``: make a project and a run directory from an Isaac Lab run."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path

from wheelleg_exp.cli.arguments import add_json, offer, print_json
from wheelleg_exp.errors import EXIT_OK

_WIDEST = 200  # letters of a row's text; README.md has the whole text


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    text = "the run's folder, or its env.yaml or deploy.yaml"
    offer("run", parser.add_argument("source", metavar="RUN", type=Path, help=text))
    text = "the robot's USD or URDF file, or a name of the package robot_descriptions"
    parser.add_argument("--robot", metavar="FILE", type=Path, required=True, help=text)
    parser.add_argument("--policy", metavar="FILE", type=Path, help="a policy: model_<n>.pt, policy.pt, or policy.onnx")
    text = "the author's Python code, of which the needed functions are copied, and then run"
    parser.add_argument("--terms", metavar="FOLDER", type=Path, help=text)
    text = "a YAML file that maps the run's names of joints and links to those of the robot file"
    parser.add_argument("--names", metavar="FILE", type=Path, help=text)
    parser.add_argument("-o", "--output", metavar="PROJECT", type=Path, required=True, help="the new project's folder")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Import a run, and print what was imported and what to do next. An error leaves no files."""
    from wheelleg_exp.stop_request import StopRequest

    with StopRequest() as stop:
        from wheelleg_exp.isaaclab_import.import_report import ASSUMED, CODE, DROPPED, shown
        from wheelleg_exp.isaaclab_import.make_project import import_apart
    stop.check()
    files = {"policy": args.policy, "terms": args.terms, "names": args.names}
    made = import_apart(args.source, args.robot, args.output, **files, command=args.command)
    place = os.path.relpath(made.path)
    if args.json:
        run_place = None if made.run is None else os.path.relpath(made.run)
        rows = [vars(row) for row in made.report.rows]
        print_json({"project": place, "run": run_place, "init_from_what": made.what, "report": rows})
        return EXIT_OK
    print(f"created {place}: {made.report.counts()}")
    for outcome in (CODE, ASSUMED, DROPPED):
        for row in made.report.of(outcome):
            print(f"  {outcome}: {row.key}: {shown(row.text, _WIDEST)}")
    print(f"report: {place}/README.md")
    print(f"next: cd {shlex.quote(place)}")
    if made.run is None:
        print("      there is no policy: give one with --policy, or train")
        print(f"      wheelleg train task={made.path.name}")
    else:
        print("      wheelleg play latest")
        print("      wheelleg evaluate latest protocol=walk")
        print(f"      wheelleg train task={made.path.name} init_from=imported_policy.pt init_from_what={made.what}")
    return EXIT_OK
