"""The actions of ``wheelleg inspect`` that read: the summary, statistics, moments, comparison, repair."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.common import UsageError
from wheelleg_exp.cli.inspecting.action import ROWS, Action, Inspected, Result, other_recording
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK

if TYPE_CHECKING:
    from wheelleg_exp.inspection.questions.selection import Selection

_LIMIT = 10  # lines that are printed


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose rows and columns."""
    group = parser.add_argument_group("what is looked at")
    group.add_argument("--env", type=int, metavar="N", help="one of the recorded environments")
    group.add_argument("--iteration", metavar="N|A-B", help="training iterations")
    group.add_argument(
        "--from", dest="begin", metavar="TIME", help="from this simulated time (2.5s) or step (150steps)"
    )
    group.add_argument("--to", dest="end", metavar="TIME", help="up to this simulated time or step")
    group.add_argument(
        "--term", action="append", default=[], metavar="NAME", help="a number, such as rewards.base_height (repeatable)"
    )
    group.add_argument("-o", "--output", type=Path, metavar="PATH", help="where a file is written")


def selection_of(args: argparse.Namespace) -> Selection:
    """Return the rows that the options choose (WheellegError when they are wrong)."""
    from wheelleg_exp.inspection.questions.selection import Selection, parse_iterations, require_order
    from wheelleg_exp.inspection.questions.spans import parse_length

    chosen = Selection(
        env_id=args.env,
        iterations=None if args.iteration is None else parse_iterations(args.iteration),
        begin=None if args.begin is None else parse_length(args.begin, "--from"),
        end=None if args.end is None else parse_length(args.end, "--to"),
    )
    require_order(chosen)
    return chosen


def _summary(_args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.inspecting.summary import print_summary
    from wheelleg_exp.inspection.questions.summary import summarize

    summary = summarize(inspected.recording, inspected.selection)
    others = inspected.target.others()
    status = inspected.target.status
    document = {**summary.as_dict(), "run_status": status, "other_recordings": [str(path) for path in others]}
    return Result(document, lambda: print_summary(summary, others, inspected.selection, status))


def _statistics(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.inspecting.rows import print_statistics
    from wheelleg_exp.inspection.questions.columns import term_statistics, units

    if not args.term:
        raise UsageError("it is not said of what", key="--stats", expected="--term NAME, such as rewards.base_height")
    found = term_statistics(inspected.recording, args.term, inspected.selection)
    words = units(inspected.recording, found, inspected.selection.env_id)
    document = {name: {**value.as_dict(), "unit": words.get(name)} for name, value in found.items()}
    return Result(document, lambda: print_statistics(found, words))


def _where(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.inspecting.rows import print_hits
    from wheelleg_exp.inspection.questions.columns import units
    from wheelleg_exp.inspection.questions.conditions import Condition
    from wheelleg_exp.inspection.questions.query import find_hits
    from wheelleg_exp.inspection.questions.spans import parse_length

    condition = Condition(args.where)
    around = None if args.around is None else parse_length(args.around, "--around")
    hits = find_hits(inspected.recording, condition, columns=args.term, around=around, selection=inspected.selection)
    document = {"condition": condition.text, "count": len(hits), "hits": [_hit(hit) for hit in hits]}
    words = units(inspected.recording, args.term or condition.names, inspected.selection.env_id)
    return Result(document, lambda: print_hits(hits, _limit(args), words))


def _hit(hit: Any) -> dict[str, Any]:
    found = {"first": asdict(hit.first), "last": asdict(hit.last), "frames": hit.frames}
    return found if hit.around is None else {**found, "rows": hit.around.table.to_pydict()}


def _compare(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.inspecting.rows import print_comparison
    from wheelleg_exp.inspection.questions.compare import compare

    other = other_recording(args)
    found = compare(inspected.recording, other)
    document = {"other": str(other.path), **found.as_dict()}
    return Result(
        document,
        lambda: print_comparison(found, inspected.recording, other, _limit(args)),
        EXIT_OK if found.is_equal else EXIT_FINDING,
        _of_all(inspected),
    )


def _of_all(inspected: Inspected) -> tuple[str, ...]:
    """Return what to know of the comparison when rows are chosen, which then are those of other actions."""
    return () if inspected.selection.is_all else ("note: --compare compares the whole recordings",)


def _limit(args: argparse.Namespace) -> int:
    return _LIMIT if args.limit is None else args.limit


def _repair(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.inspecting.rows import print_repaired
    from wheelleg_exp.recording.reading.repair import repair

    with inspected.target.resting():
        done = repair(inspected.path, args.output)
    document = {**asdict(done), "health": done.health.as_dict()}
    return Result(document, lambda: print_repaired(done))


def _list(_args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.inspecting.rows import print_names
    from wheelleg_exp.inspection.questions.columns import number_list

    found = number_list(inspected.recording, inspected.selection.env_id)
    return Result([asdict(entry) for entry in found], lambda: print_names(found))


def _flag(name: str, text: str) -> Any:
    return lambda parser: parser.add_argument(name, action="store_true", help=text)


def _add_where(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--where", metavar="CONDITION", help="print when it holds: 'terminations.base_contact', 'base.pitch > 0.3'"
    )
    parser.add_argument("--around", metavar="LENGTH", help="with the rows around it: 0.5s, 200ms, 30steps")
    parser.add_argument("--limit", type=_count, metavar="N", help="how many are printed (default: 10)")


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is no number of lines; expected 0 or more")
    return int(text)


def _add_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--compare", metavar="RUN|FILE", help="another recording; exit status 1 when they differ")


SUMMARY = Action("summary", _flag("--summary", "print the summary beside what else is asked for"), _summary, ROWS)
STATISTICS = Action("stats", _flag("--stats", "print the statistics of each --term"), _statistics, (*ROWS, "term"))
ACTIONS: tuple[Action, ...] = (
    Action("repair", _flag("--repair", "write a mended copy of a recording that was cut off"), _repair, ("output",)),
    SUMMARY,
    Action("names", _flag("--names", "print the names of all recorded numbers"), _list, ("env",)),
    STATISTICS,
    Action("where", _add_where, _where, (*ROWS, "term", "around", "limit")),
    Action("compare", _add_compare, _compare, ("limit",)),
)
