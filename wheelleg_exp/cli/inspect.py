"""``wheelleg inspect RUN|FILE``: what a recording holds, and answers to questions about it.

Without an option that asks for something else the summary is printed. Every option that does something of its own
is an action; several may stand together, and run in the order of the table.
"""

from __future__ import annotations

import argparse
import sys

from wheelleg_exp.cli.common import add_json, add_root, print_json
from wheelleg_exp.cli.inspect_actions import PICTURE_ACTIONS as PICTURES
from wheelleg_exp.cli.inspect_actions import READING_ACTIONS as READING
from wheelleg_exp.cli.inspect_actions import (
    STATISTICS,
    SUMMARY,
    Action,
    Inspected,
    add_selection,
    require_used,
    selection_of,
)

# Files and figures first and the viewer last, because that one stays open.
ACTIONS: tuple[Action, ...] = (*READING, *PICTURES)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("recording", metavar="RUN|FILE", help="a run directory, its id, 'latest', or a recording")
    parser.add_argument("--play", action="store_true", help="the run's newest play instead of its training")
    parser.add_argument("--id", metavar="ID", help="which recording of a file that holds several")
    add_root(parser)
    add_selection(parser)
    for action in ACTIONS:
        action.configure(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Do what was asked for; the summary when nothing was."""
    from wheelleg_exp.inspection.recording_target import find_target

    chosen = [action for action in ACTIONS if action.is_chosen(args)] or [STATISTICS if args.term else SUMMARY]
    require_used(args, chosen, ACTIONS)
    target = find_target(args.recording, args.root, play=args.play)
    inspected = Inspected(target, selection_of(args), args.id)
    results = {}
    for action in chosen:
        results[action.name] = result = action.run(args, inspected)
        for note in result.notes:
            print(note, file=sys.stderr)
        if not args.json:
            result.show()
    if args.json:
        print_json({"recording": str(target.path), **{name: result.document for name, result in results.items()}})
    return max(result.status for result in results.values())
