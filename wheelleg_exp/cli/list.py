"""``wheelleg list``: what there is."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wheelleg_exp.cli.common import UsageError, add_config_dir, add_json, print_json, print_table
from wheelleg_exp.config import catalog
from wheelleg_exp.config.catalog import Entry
from wheelleg_exp.errors import EXIT_OK, nearest_name

KINDS = ("tasks", "terms", "groups", "options", "runs")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("kind", nargs="?", default="tasks", metavar="{" + ",".join(KINDS) + "}", help="what to list")
    parser.add_argument("group", nargs="?", metavar="GROUP", help="the group whose terms or options to list")
    parser.add_argument("--root", type=Path, default=Path("runs"), help="where the runs are (default: runs)")
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the list as a table or as JSON."""
    if args.kind not in KINDS:
        raise UsageError(
            "nothing of that name to list",
            key=str(args.kind),
            expected="one of " + ", ".join(KINDS),
            nearest=nearest_name(str(args.kind), KINDS),
        )
    columns, rows = _LISTS[args.kind](args)
    if args.json:
        print_json([dict(zip(columns, row, strict=True)) for row in rows])
    else:
        print_table(columns, rows)
    return EXIT_OK


Table = tuple[list[str], list[list[Any]]]


def _tasks(args: argparse.Namespace) -> Table:
    return _entries(["task", "help", "file"], catalog.tasks(args.config_dirs))


def _groups(args: argparse.Namespace) -> Table:
    return ["group"], [[name] for name in catalog.groups(args.config_dirs)]


def _options(args: argparse.Namespace) -> Table:
    names = [args.group] if args.group else catalog.groups(args.config_dirs)
    entries = [entry for name in names for entry in catalog.options(name, args.config_dirs)]
    return _entries(["group", "option", "help", "file"], entries)


def _terms(args: argparse.Namespace) -> Table:
    return _entries(["group", "term", "target", "help"], catalog.terms(args.group, args.config_dirs))


def _runs(args: argparse.Namespace) -> Table:
    from wheelleg_exp.run.listing import list_runs
    from wheelleg_exp.run.timestamps import utc_text

    summaries = [{**asdict(run), "started": utc_text(run.started)} for run in list_runs(args.root)]
    columns = ["id", "task", "status", "started", "ended", "seeds", "path"]
    return columns, [[summary.get(column) for column in columns] for summary in summaries]


def _entries(columns: list[str], entries: list[Entry]) -> Table:
    fields = {"task": "name", "option": "name", "term": "name"}
    return columns, [[getattr(entry, fields.get(column, column)) for column in columns] for entry in entries]


_LISTS = {"tasks": _tasks, "groups": _groups, "options": _options, "terms": _terms, "runs": _runs}
