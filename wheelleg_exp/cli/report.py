"""Define the command ``wheelleg report RUN``, which writes a report about one or several runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from wheelleg_exp.cli.arguments import add_json, add_root, offer, print_json
from wheelleg_exp.errors import EXIT_OK
from wheelleg_exp.paths import show_file


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    text = "a run directory, its id, 'latest', the folder of an agent's run, or a sweep; several are compared"
    offer("run", parser.add_argument("run", nargs="+", metavar="RUN", help=text))
    text = "the file to write (default: report.html in the run's or sweep's folder; comparison.html for several)"
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help=text)
    add_root(parser)
    parser.add_argument("--no-pictures", action="store_true", help="leave out the pictures of the robot")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Write an HTML report about one or several runs, and print the path of the HTML file."""
    from wheelleg_exp.report import make_report

    made = make_report(args.run, args.root, args.output, args.command, pictures=not args.no_pictures)
    if args.json:
        print_json({"run": str(made.run), "report": str(made.path), "size": made.size, "notes": list(made.notes)})
        return EXIT_OK
    for note in made.notes:
        print(f"note: {note}")
    print(f"report: {show_file(made.path)} ({made.size / 1e6:.2f} MB, one file)")
    return EXIT_OK
