"""``wheelleg list``: list tasks, terms, groups, options, pipelines, runs, and sweeps."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from wheelleg_exp.cli.arguments import UsageError, add_config_dir, add_json, offer, print_json
from wheelleg_exp.cli.printing.terminal import hanging, print_blocks, print_table, screen_width, table_width
from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.config.explaining.catalog import Entry
from wheelleg_exp.definitions import LAST, LISTED, percent
from wheelleg_exp.errors import EXIT_OK, RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.run import run_list
from wheelleg_exp.run.run_list import RunSummary, SweepSummary
from wheelleg_exp.run.timestamps import utc_text

_NEVER = datetime.min.replace(tzinfo=UTC)  # A run without a known start time counts as the oldest run.
_LEAST_ID = 16  # Print at least 16 characters of a run id.
_PROBLEMS_SHOWN = 10
_LEGEND = (
    f"\nreturn: mean of {LAST} of the training; time-out: share of its environments whose last episode ended by "
    "time-out; played, evaluated: surviving episodes of the last play and of the last evaluation"
)


class Listed(NamedTuple):
    """One list of the command: its table, its ``--json`` documents, and the text that replaces an empty table."""

    columns: list[str]
    rows: list[list[object]]
    documents: list[dict[str, object]]
    no_rows: str = ""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    kinds = "{" + ",".join(_LISTS) + "}"
    offer([*_LISTS], parser.add_argument("kind", nargs="?", default="tasks", metavar=kinds, help="what to list"))
    text = "the group (reward) whose terms or options to list"
    offer("group", parser.add_argument("group", nargs="?", metavar="GROUP", help=text))
    of_runs = parser.add_argument_group("list runs")
    text = "only runs that meet every condition: task=stand status!=failed 'return>5' name='abl*' "
    text += "agent.algorithm.gamma=0.99"
    of_runs.add_argument("--filter", nargs="+", action="extend", default=[], metavar="CONDITION", help=text)
    text = "sort by a column or a key of the config, the largest first"
    offer("key", of_runs.add_argument("--sort", metavar="KEY", help=text))
    of_runs.add_argument("--reverse", action="store_true", help="list the smallest value, or the oldest run, first")
    of_runs.add_argument("--sweep", metavar="SWEEP", help="only the runs of a sweep ('latest'), with their differences")
    parser.add_argument("--root", type=Path, metavar="DIR", help="the folder of the runs (default: runs)")
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the list that ``wheelleg list`` was asked for, such as the runs, as a table or as JSON."""
    if args.kind not in _LISTS:
        expected, nearest = "one of " + ", ".join(_LISTS), nearest_name(args.kind, _LISTS)
        raise UsageError("wheelleg cannot list this", key=args.kind, expected=expected, nearest=nearest)
    if args.kind != "runs" and (args.filter or args.sort or args.reverse or args.sweep):
        message = "--filter, --sort, --reverse and --sweep apply only to the list of runs"
        raise UsageError(message, key=args.kind, expected="list runs")
    if args.group is not None and args.kind not in ("terms", "options"):
        message = f"'{args.kind}' has no groups"
        expected = "--filter with conditions, or --root with a folder" if args.kind == "runs" else "no further word"
        raise UsageError(message, key=args.group, expected=expected)
    listed = _LISTS[args.kind](args)
    rows = [list(map(_cell, row)) for row in listed.rows]
    if args.json:
        print_json(listed.documents)
    elif listed.no_rows and not rows:
        print(listed.no_rows)
    elif args.kind in ("runs", "sweeps"):
        # Print a table of runs or sweeps, and below the table their problems and a legend of the columns.
        width = max(screen_width() - table_width(listed.columns[1:], [row[1:] for row in rows]) - 2, _LEAST_ID)
        half = (width - 1) // 2
        for row in rows:  # Replace the middle of a long run id by '…', because run ids differ mostly at their ends.
            text = str(row[0])
            row[0] = text if len(text) <= width else f"{text[: width - half - 1]}…{text[-half:]}"
        print_table(listed.columns, rows, lines=False)
        lines = [f"{entry['id']}: {entry['problem']}" for entry in listed.documents if entry["problem"]]
        more = len(lines) - _PROBLEMS_SHOWN
        lines = lines[:_PROBLEMS_SHOWN] + ([f"and {more} more with a problem; --json lists them"] if more > 0 else [])
        for line in lines:
            print(hanging(line, 4))
        if any(entry.get("figures") or entry.get("played") for entry in listed.documents):
            print(hanging(_LEGEND, 0))
    elif args.kind == "terms":
        print_blocks(listed.columns, rows, heads=2)
    else:
        print_table(listed.columns, rows, heads=2 if args.kind == "options" else 1)
    return EXIT_OK


def _cell(value: object) -> object:
    """Return a value as a cell: a dash for None, a path relative to the current folder, a list without brackets."""
    if isinstance(value, Path) and value.is_relative_to(Path.cwd()):
        return value.relative_to(Path.cwd())
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "-" if value is None else value


def _table(columns: list[str], rows: list[list[object]]) -> Listed:
    return Listed(columns, rows, [dict(zip(columns, row, strict=True)) for row in rows])


def _entries(columns: list[str], entries: list[Entry]) -> Listed:
    fields = [{"task": "name", "option": "name"}.get(column, column) for column in columns]
    return _table(columns, [[getattr(entry, name) for name in fields] for entry in entries])


def _tasks(args: argparse.Namespace) -> Listed:
    return _entries(["task", "help", "file"], catalog.options("task", args.config_dirs))


def _groups(args: argparse.Namespace) -> Listed:
    return _table(["group"], [[name] for name in catalog.groups(args.config_dirs)])


def _options(args: argparse.Namespace) -> Listed:
    names = [args.group] if args.group else catalog.groups(args.config_dirs)
    entries = [entry for name in names for entry in catalog.options(name, args.config_dirs)]
    return _entries(["group", "option", "help", "file"], entries)


def _terms(args: argparse.Namespace) -> Listed:
    from wheelleg_exp.config.explaining.catalog import MODULES, library, signature_of
    from wheelleg_exp.terms.term_binding import RESERVED, resolve_target

    # ``wheelleg list terms`` accepts a config group such as 'reward', and a config section such as 'rewards'.
    section = {name: section for section in RESERVED for name in (section, section.removesuffix("s"))}.get(args.group)
    group = args.group if section is None else section.removesuffix("s")
    known = catalog.groups(args.config_dirs)
    stock = catalog.terms(group, args.config_dirs) if section is None or group in known else []
    rows: list[list[object]] = []
    for entry in stock:
        try:
            takes = signature_of(resolve_target(str(entry.target), f"{entry.group}.{entry.name}"))
        except WheellegError:
            takes = ""
        rows.append([entry.group, entry.name, entry.help, entry.target, takes, entry.file])
    used = {entry.target for entry in stock}
    for term in library():
        if term.target not in used and (group is None or section == term.section):
            name = term.target.rsplit(".", 1)[-1]
            rows.append([term.section.removesuffix("s"), name, term.help, term.target, term.signature, None])
    order = {name.removesuffix("s"): index for index, name in enumerate(MODULES.values())}
    rows.sort(key=lambda row: order.get(str(row[0]), len(order)))
    return _table(["group", "term", "help", "target", "takes", "file"], rows)


def _pipelines(args: argparse.Namespace) -> Listed:
    """Return the pipelines that configs declare, followed by the started pipelines, the newest first."""
    from wheelleg_exp.jobs.pipeline.run_pipeline import compose_pipeline
    from wheelleg_exp.run.run_directory import PIPELINE_NAME, PIPELINES
    from wheelleg_exp.run.run_index import PipelineIndex
    from wheelleg_exp.terms.key_syntax import PIPELINE

    rows: list[list[object]] = []
    for entry in catalog.options(PIPELINE, args.config_dirs):
        try:
            phases = ", ".join(compose_pipeline([f"{PIPELINE}={entry.name}"], args.config_dirs).phases)
        except WheellegError as error:  # Print only the error's first line; ``wheelleg train`` prints all lines.
            phases = f"wrong: {error.message.splitlines()[0].rstrip(':')}"
        rows.append([entry.name, "declared", phases, entry.help, entry.file])
    for path in sorted((_runs_folder(args.root) / PIPELINES).glob(f"*/{PIPELINE_NAME}"), reverse=True):
        with suppress(RunDirectoryError):  # Skip a pipeline with a damaged index file.
            index = PipelineIndex.load(path.parent)
            phases = ", ".join(f"{phase['name']} {phase['status']}" for phase in index.phases)
            rows.append([index.data["name"], index.data["status"], phases, index.data["why"], index.folder])
    return _table(["pipeline", "status", "phases", "help", "file"], rows)


def _runs(args: argparse.Namespace) -> Listed:
    """Return the table of runs; for runs of a sweep, show the swept config keys instead of ``task`` and ``resume``."""
    folder = _runs_folder(args.root)
    every = run_list.list_runs(folder)
    if args.sweep is not None:
        members = run_list.runs_of(run_list.open_sweep(args.sweep, folder))
        every = [run for run in every if run.path.resolve() in members]
    found = run_list.filter_runs(every, args.filter)
    if args.sort is not None:
        found = run_list.sort_runs(found, args.sort, reverse=args.reverse)
    elif args.reverse:
        found.reverse()
    of_sweeps = run_list.swept_runs(folder)
    swept = [of_sweeps.get(run.path.resolve()) for run in found]
    documents = []
    for run, own in zip(found, swept, strict=True):
        in_sweep = {"sweep": own.sweep if own else None, "swept": dict(own.values) if own else {}}
        documents.append(_document(run) | {"seeds": list(run.seeds) or None} | in_sweep)
    columns, rows = ["id", "task", "status", *LISTED, "resume"], list(map(_run_row, found))
    of_one_sweep = [own for own in swept if own]
    if found and len(of_one_sweep) == len(found) and len({own.sweep for own in of_one_sweep}) == 1:
        keys = list(dict.fromkeys(key for own in of_one_sweep for key in own.values))
        columns = ["id", *_short(keys), "status", *LISTED]
        values = [[own.values.get(key) for key in keys] for own in of_one_sweep]
        rows = [[row[0], *own, *row[2:-1]] for row, own in zip(rows, values, strict=True)]
    # Omit empty columns of the table to make space for complete run ids, because users copy run ids.
    optional = ("played", "evaluated", "resume")
    used = [i for i, name in enumerate(columns) if name not in optional or any(row[i] is not None for row in rows)]
    columns, rows = [columns[i] for i in used], [[row[i] for i in used] for row in rows]
    return Listed(columns, rows, documents, f"no run of {len(every)} matches" if args.filter else "")


def _short(keys: Sequence[str]) -> list[str]:
    """Shorten keys such as ``env.rewards.alive.weight`` to ``weight`` or, if ambiguous, to ``alive.weight``."""
    taken = {"id", "status", *LISTED}

    def name(key: str, parts: int) -> str:
        return ".".join(key.split(".")[-parts:])

    def fits(key: str, parts: int) -> bool:
        return name(key, parts) not in taken and [name(other, parts) for other in keys].count(name(key, parts)) == 1

    return [next((name(k, n) for n in range(1, k.count(".") + 1) if fits(k, n)), k) for k in keys]


def _sweeps(args: argparse.Namespace) -> Listed:
    rows: list[list[object]] = []
    found = run_list.list_sweeps(_runs_folder(args.root))
    for sweep in found:
        jobs = ", ".join(f"{count} {status}" for status, count in sweep.jobs.items())
        took = None if sweep.ended is None else (datetime.fromisoformat(sweep.ended) - sweep.started).total_seconds()
        rows.append([sweep.id, sweep.status, jobs or None, " ".join(sweep.swept) or None, _duration(took)])
    return Listed(["id", "status", "jobs", "swept", "took"], rows, list(map(_document, found)))


def _document(summary: RunSummary | SweepSummary) -> dict[str, object]:
    """Return a run or sweep as a mapping for JSON; a value is null if a damaged file does not contain it."""
    return {**asdict(summary), "started": None if summary.started == _NEVER else utc_text(summary.started)}


def _runs_folder(root: Path | None) -> Path:
    """Return the folder of all runs; raise WheellegError if the folder given in ``--root`` does not exist."""
    if root is None or root.is_dir():
        return root or Path("runs")
    parent = root.absolute().parent
    names = [path.name for path in parent.iterdir() if path.is_dir()] if parent.is_dir() else []
    found = nearest_name(root.name, names)
    nearest, expected = str(root.with_name(found)) if found else None, "the folder of the runs (run.root)"
    message = "the folder of the runs does not exist"
    raise WheellegError(message, key=str(root), where="--root", expected=expected, nearest=nearest)


def _run_row(run: RunSummary) -> list[object]:
    done = None if run.iterations is None and run.max_iterations is None else f"{run.iterations or 0}"
    total = "" if run.max_iterations is None else f"/{run.max_iterations}"
    reward, evaluated = run.figures.get("return"), None
    metrics, protocol = run.evaluated.get("metrics"), run.evaluated.get("protocol")
    if isinstance(metrics, Mapping) and isinstance(protocol, str):  # the protocol, and the survival in its first test
        shares = (value for name, value in metrics.items() if str(name).endswith("/survival"))
        evaluated = " ".join(filter(None, (protocol, _percent(next(shares, None)))))
    return [
        run.id,
        run.task,
        run.status,
        done and done + total,
        None if reward is None else f"{reward:.2f}",
        _percent(run.figures.get("time_out")),
        _survived(run.played),
        evaluated,
        _duration(run.seconds),
        ("from start" if run.checkpoint is None else f"from {run.checkpoint}") if run.resumable else None,
    ]


def _percent(value: object) -> str | None:
    return percent(value) if isinstance(value, (int, float)) else None


def _survived(played: Mapping[str, object]) -> str | None:
    """Return the share of surviving episodes of a ``wheelleg play``: a fraction such as ``60/64``, or a percentage."""
    survival, episodes, unfinished = (played.get(key) for key in ("survival", "episodes", "unfinished"))
    if not isinstance(survival, (int, float)) or not isinstance(episodes, int) or not isinstance(unfinished, int):
        return _percent(survival)
    ended = episodes - unfinished
    return f"{round(survival * ended)}/{ended}"


def _duration(seconds: float | None) -> str | None:
    if seconds is None:
        return None
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}h{minutes:02}m"
    return f"{minutes}m{seconds:02}s" if minutes else f"{seconds}s"


_LISTS = {"tasks": _tasks, "terms": _terms, "groups": _groups, "options": _options}
_LISTS |= {"pipelines": _pipelines, "runs": _runs, "sweeps": _sweeps}
