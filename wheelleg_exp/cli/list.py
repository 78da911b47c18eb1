"""``wheelleg list``: list tasks, terms, groups, options, pipelines, runs, and sweeps."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from wheelleg_exp.cli.arguments import UsageError, add_config_dir, add_json, print_json
from wheelleg_exp.cli.printing.terminal import print_blocks, print_table
from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.config.explaining.catalog import Entry
from wheelleg_exp.errors import EXIT_OK, WheellegError, nearest_name

KINDS = ("tasks", "terms", "groups", "options", "pipelines", "runs", "sweeps")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("kind", nargs="?", default="tasks", metavar="{" + ",".join(KINDS) + "}", help="what to list")
    parser.add_argument("group", nargs="?", metavar="GROUP", help="the group (reward) whose terms or options to list")
    of_runs = parser.add_argument_group("list runs")
    of_runs.add_argument(
        "--filter",
        nargs="+",
        action="extend",
        default=[],
        metavar="CONDITION",
        help="only runs that meet every condition: task=stand status!=failed 'return>5' name='abl*' "
        "agent.algorithm.gamma=0.99",
    )
    of_runs.add_argument("--sort", metavar="KEY", help="sort by a column or a key of the config, the largest first")
    of_runs.add_argument("--reverse", action="store_true", help="the smallest, or the oldest, first")
    of_runs.add_argument("--sweep", metavar="SWEEP", help="only the runs of a sweep ('latest'), with their differences")
    parser.add_argument("--root", type=Path, metavar="DIR", help="the folder of the runs (default: runs)")
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the list as a table or as JSON."""
    if args.kind not in KINDS:
        raise UsageError(
            "cannot list this",
            key=str(args.kind),
            expected="one of " + ", ".join(KINDS),
            nearest=nearest_name(str(args.kind), KINDS),
        )
    if args.kind != "runs" and (args.filter or args.sort or args.reverse or args.sweep):
        raise UsageError("--filter, --sort, --reverse and --sweep are for runs", key=args.kind, expected="list runs")
    columns, rows, documents = _listed(args)
    if args.json:
        print_json(documents)
    elif args.filter and not rows:
        from wheelleg_exp.cli.list_runs import no_match

        print(no_match(args.root, args.sweep))
    else:
        _show(args.kind, columns, [list(map(_cell, row)) for row in rows], documents)
    return EXIT_OK


def _listed(args: argparse.Namespace) -> tuple[list[str], list[list[Any]], list[dict[str, Any]]]:
    """Return the columns and rows of the table, and the documents of ``--json``."""
    if args.kind in ("runs", "sweeps"):
        from wheelleg_exp.cli import list_runs

        if args.kind == "sweeps":
            return list_runs.sweeps(args.root)
        return list_runs.runs(args.root, args.filter, args.sort, args.sweep, reverse=args.reverse)
    columns, rows = _LISTS[args.kind](args)
    return columns, rows, [dict(zip(columns, row, strict=True)) for row in rows]


def _show(kind: str, columns: list[str], rows: list[list[Any]], documents: list[dict[str, Any]]) -> None:
    if kind in ("runs", "sweeps"):
        from wheelleg_exp.cli import list_runs

        list_runs.show(columns, rows, documents)
    elif kind == "terms":
        print_blocks(columns, rows, heads=2)
    else:
        print_table(columns, rows, heads=2 if kind == "options" else 1)


def _cell(value: Any) -> Any:
    """Return a value as a cell: a dash for None, a path relative to the current folder, a list without brackets."""
    if isinstance(value, Path) and value.is_relative_to(Path.cwd()):
        return value.relative_to(Path.cwd())
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "-" if value is None else value


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
    from wheelleg_exp.config.explaining.catalog import MODULES, library

    section = _section(args.group) if args.group else None
    group = args.group if section is None else section.removesuffix("s")
    known = catalog.groups(args.config_dirs)
    stock = catalog.terms(group, args.config_dirs) if section is None or group in known else []
    rows = [_stock_row(entry) for entry in stock]
    used = {entry.target for entry in stock}
    found = [t for t in library() if t.target not in used and (group is None or section == t.section)]
    names = [t.target.rsplit(".", 1)[-1] for t in found]
    rows += [
        [t.section.removesuffix("s"), name, t.help, t.target, t.signature, None]
        for name, t in zip(names, found, strict=True)
    ]
    order = {name.removesuffix("s"): index for index, name in enumerate(MODULES.values())}
    rows.sort(key=lambda row: order.get(row[0], len(order)))
    return ["group", "term", "help", "target", "takes", "file"], rows


def _section(name: str) -> str | None:
    """Return the section for the name of a group or a section: ``rewards`` for ``reward`` and ``rewards``."""
    from wheelleg_exp.terms.term_binding import RESERVED

    return next((section for section in RESERVED if name in (section, section.removesuffix("s"))), None)


def _stock_row(entry: Entry) -> list[Any]:
    from wheelleg_exp.config.explaining.catalog import signature_of
    from wheelleg_exp.terms.term_binding import resolve_target

    try:
        takes = signature_of(resolve_target(str(entry.target), f"{entry.group}.{entry.name}"))
    except WheellegError:
        takes = ""
    return [entry.group, entry.name, entry.help, entry.target, takes, entry.file]


def _entries(columns: list[str], entries: list[Entry]) -> Table:
    fields = {"task": "name", "option": "name", "term": "name"}
    return columns, [[getattr(entry, fields.get(column, column)) for column in columns] for entry in entries]


def _pipelines(args: argparse.Namespace) -> Table:
    """Return the declared pipelines, then the started ones, the newest first."""
    from wheelleg_exp.cli.list_runs import runs_folder
    from wheelleg_exp.jobs.pipeline.pipeline_settings import compose_pipeline
    from wheelleg_exp.run.run_index import pipelines_below
    from wheelleg_exp.terms.key_syntax import PIPELINE

    rows: list[list[Any]] = []
    for entry in catalog.options(PIPELINE, args.config_dirs):
        try:
            phases = ", ".join(compose_pipeline([f"{PIPELINE}={entry.name}"], args.config_dirs).phases)
        except WheellegError as error:  # reported in full when the pipeline is used
            phases = f"wrong: {error.message.splitlines()[0].rstrip(':')}"
        rows.append([entry.name, "declared", phases, entry.help, entry.file])
    for index in pipelines_below(runs_folder(args.root)):
        phases = ", ".join(f"{phase['name']} {phase['status']}" for phase in index.phases)
        rows.append([index.data["name"], index.data["status"], phases, index.data["why"], index.folder])
    return ["pipeline", "status", "phases", "help", "file"], rows


_LISTS = {"tasks": _tasks, "groups": _groups, "options": _options, "pipelines": _pipelines, "terms": _terms}
