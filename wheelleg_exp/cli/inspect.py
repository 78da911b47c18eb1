"""``wheelleg inspect RUN|FILE``: show the contents of a recording, and answer questions about it.

Without an action, the summary is printed. Several actions can be combined; they run in the order of ``ACTIONS``.
"""

from __future__ import annotations

import argparse
import sys

from wheelleg_exp.cli.arguments import add_json, add_root, print_json
from wheelleg_exp.cli.inspect_actions import (
    PICTURE_ACTIONS,
    READING_ACTIONS,
    STATISTICS,
    SUMMARY,
    Action,
    Inspected,
    add_selection,
    require_used,
    selection_of,
)

# The viewer is the last action, because it stays open.
ACTIONS: tuple[Action, ...] = (*READING_ACTIONS, *PICTURE_ACTIONS)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("recording", metavar="RUN|FILE", help="a run directory, its id, 'latest', or a recording")
    parser.add_argument("--play", action="store_true", help="the run's newest play instead of its training")
    parser.add_argument("--id", metavar="ID", help="which recording, if the file contains several")
    add_root(parser)
    add_selection(parser)
    for action in ACTIONS:
        action.configure(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Run the chosen actions; without one, print the summary, or with ``--term`` the statistics."""
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
