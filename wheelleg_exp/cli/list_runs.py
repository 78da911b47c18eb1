"""``wheelleg list runs`` and ``wheelleg list sweeps``: one line for each run or sweep; ``--json`` prints all facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from wheelleg_exp.cli.printing.terminal import hanging, print_table, screen_width, table_width
from wheelleg_exp.definitions import LAST, LISTED, percent
from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.run import run_list
from wheelleg_exp.run.run_list import RunSummary, SweepSummary, list_runs, list_sweeps
from wheelleg_exp.run.timestamps import utc_text

ROOT = Path("runs")
_NEVER = datetime.min.replace(tzinfo=UTC)  # an unknown start
_LEAST_ID = 16  # the least width of an id, in characters

RUN_COLUMNS = ["id", "task", "status", *LISTED, "resume"]
LEGEND = (
    f"\nreturn: mean of {LAST} of the training; time-out: share of its environments whose last episode ended by "
    "time-out; played, evaluated: surviving episodes of the last play and of the last evaluation"
)
_OPTIONAL = ("played", "evaluated", "resume")  # columns that are left out if they are empty
SWEEP_COLUMNS = ["id", "status", "jobs", "swept", "took"]

_PROBLEMS_SHOWN = 10

Listed = tuple[list[str], list[list[Any]], list[dict[str, Any]]]


def runs(
    root: Path | None,
    conditions: Sequence[str] = (),
    sort: str | None = None,
    sweep: str | None = None,
    *,
    reverse: bool = False,
) -> Listed:
    """Return the columns and rows for the runs below ``root``, and the JSON documents.

    If all runs belong to one sweep, the swept keys replace the columns ``task`` and ``resume``.

    Args:
        root: the folder of all runs.
        conditions: the conditions that the runs must meet, see ``run_list.filter_runs``.
        sort: the key to sort by, see ``run_list.sort_runs``; by default the newest run is first.
        sweep: the sweep of the runs: a path, an id or ``latest``.
        reverse: whether to reverse the order.

    Raises:
        WheellegError: the folder or the sweep does not exist, or a condition or key is wrong.
    """
    folder = runs_folder(root)
    swept = run_list.swept_runs(folder)
    found = run_list.filter_runs(_of_sweep(list_runs(folder), sweep, folder), conditions)
    if sort is not None:
        found = run_list.sort_runs(found, sort, reverse=reverse)
    elif reverse:
        found.reverse()
    mine = {run.path: swept.get(run.path.resolve()) for run in found}
    documents = [_document(run) | _swept_document(mine[run.path]) for run in found]
    keys = _differing([mine[run.path] for run in found])
    if keys is None:
        return *_without_empty(RUN_COLUMNS, [_run_row(run) for run in found]), documents
    columns = ["id", *_short(keys), "status", *LISTED]
    rows = [[row[0], *_values_of(mine[run.path], keys), *row[2:-1]] for run in found for row in [_run_row(run)]]
    return *_without_empty(columns, rows), documents


def _without_empty(columns: list[str], rows: list[list[Any]]) -> tuple[list[str], list[list[Any]]]:
    """Return a table without empty optional columns, to leave space for whole ids, which users copy."""
    used = [at for at, name in enumerate(columns) if name not in _OPTIONAL or any(row[at] is not None for row in rows)]
    return [columns[at] for at in used], [[row[at] for at in used] for row in rows]


def no_match(root: Path | None, sweep: str | None) -> str:
    """Return the message for a filter that no run matches."""
    folder = runs_folder(root)
    return f"no run of {len(_of_sweep(list_runs(folder), sweep, folder))} matches"


def _of_sweep(found: list[RunSummary], name: str | None, root: Path) -> list[RunSummary]:
    if name is None:
        return found
    index = run_list.find_sweep(name, root)
    if index is None:
        known = [sweep.id for sweep in list_sweeps(root)]
        expected = "'latest', or one of " + (", ".join(known[:5]) or "(there is none yet)")
        raise WheellegError(
            f"there is no sweep '{name}'", key="--sweep", expected=expected, nearest=nearest_name(name, known)
        )
    members = run_list.runs_of(index)
    return [run for run in found if run.path.resolve() in members]


def _differing(swept: Sequence[run_list.SweptRun | None]) -> list[str] | None:
    """Return the swept keys of runs of one sweep; None if the runs do not belong to one sweep."""
    if not swept or None in swept or len({own.sweep for own in swept if own}) > 1:
        return None
    return list(dict.fromkeys(key for own in swept if own for key in own.values))


def _short(keys: Sequence[str]) -> list[str]:
    """Return the shortest ends of the keys that differ from each other and from the column names."""
    taken = {"id", "status", *LISTED}

    def name(key: str, parts: int) -> str:
        return ".".join(key.split(".")[-parts:])

    def fits(key: str, parts: int) -> bool:
        return name(key, parts) not in taken and [name(other, parts) for other in keys].count(name(key, parts)) == 1

    return [next((name(k, n) for n in range(1, k.count(".") + 1) if fits(k, n)), k) for k in keys]


def _values_of(own: run_list.SweptRun | None, keys: Sequence[str]) -> list[str | None]:
    return [own.values.get(key) if own else None for key in keys]


def _swept_document(own: run_list.SweptRun | None) -> dict[str, Any]:
    return {"sweep": own.sweep if own else None, "swept": dict(own.values) if own else {}}


def sweeps(root: Path | None) -> Listed:
    """Return the columns and rows for the sweeps below ``root``, and the JSON documents."""
    found = list_sweeps(runs_folder(root))
    return SWEEP_COLUMNS, [_sweep_row(sweep) for sweep in found], [_document(sweep) for sweep in found]


def show(columns: Sequence[str], rows: Sequence[Sequence[Any]], documents: Sequence[Mapping[str, Any]]) -> None:
    """Print a table of runs or sweeps, and below it their problems and a legend."""
    print_table(columns, _fitted(columns, rows), lines=False)
    for line in problems(documents):
        print(hanging(line, 4))
    if any(entry.get("figures") or entry.get("played") for entry in documents):
        print(hanging(LEGEND, 0))


def problems(documents: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for each of the newest runs or sweeps with a problem."""
    lines = [f"{entry['id']}: {entry['problem']}" for entry in documents if entry["problem"]]
    more = len(lines) - _PROBLEMS_SHOWN
    return lines[:_PROBLEMS_SHOWN] + ([f"and {more} more with a problem; --json lists them"] if more > 0 else [])


def runs_folder(root: Path | None) -> Path:
    """Return the folder of all runs; raise WheellegError if the given folder does not exist."""
    if root is not None and not root.is_dir():
        raise WheellegError(
            "there is no such folder",
            key=str(root),
            where="--root",
            expected="the folder of the runs (run.root)",
            nearest=_folder_like(root),
        )
    return root or ROOT


def _folder_like(path: Path) -> str | None:
    parent = path.absolute().parent
    names = [p.name for p in parent.iterdir() if p.is_dir()] if parent.is_dir() else []
    found = nearest_name(path.name, names)
    return str(path.with_name(found)) if found else None


def _run_row(run: RunSummary) -> list[Any]:
    done = None if run.iterations is None and run.max_iterations is None else f"{run.iterations or 0}"
    total = "" if run.max_iterations is None else f"/{run.max_iterations}"
    return [
        run.id,
        run.task,
        run.status,
        done and done + total,
        _number(run.figures, "return", "{:.2f}"),
        _percent(run.figures.get("time_out")),
        _survived(run.played),
        _evaluated(run.evaluated),
        _duration(run.seconds),
        ("from start" if run.checkpoint is None else f"from {run.checkpoint}") if run.resumable else None,
    ]


def _sweep_row(sweep: SweepSummary) -> list[Any]:
    jobs = ", ".join(f"{count} {status}" for status, count in sweep.jobs.items())
    took = None if sweep.ended is None else (datetime.fromisoformat(sweep.ended) - sweep.started).total_seconds()
    return [sweep.id, sweep.status, jobs or None, " ".join(sweep.swept) or None, _duration(took)]


def _document(summary: RunSummary | SweepSummary) -> dict[str, Any]:
    """Return the JSON document of a run or sweep. Unknown facts of a damaged one are null."""
    started = None if summary.started == _NEVER else utc_text(summary.started)
    document = {**asdict(summary), "started": started}
    return document | {"seeds": list(summary.seeds) or None} if isinstance(summary, RunSummary) else document


def _fitted(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """Return rows with ids that are short enough for the screen. The middle is cut out, because the ends differ."""
    room = max(screen_width() - table_width(columns[1:], [row[1:] for row in rows]) - 2, _LEAST_ID)
    return [[_shortened(str(row[0]), room), *row[1:]] for row in rows]


def _shortened(text: str, width: int) -> str:
    half = (width - 1) // 2
    return text if len(text) <= width else f"{text[: width - half - 1]}…{text[-half:]}"


def _number(values: Mapping[str, Any], key: str, form: str) -> str | None:
    value = values.get(key)
    return form.format(value) if isinstance(value, (int, float)) else None


def _percent(value: Any) -> str | None:
    return percent(value) if isinstance(value, (int, float)) else None


def _survived(played: Mapping[str, Any]) -> str | None:
    """Return the surviving and the ended episodes of a play, ``60/64``; only their share if the numbers are missing."""
    survival, episodes, unfinished = (played.get(key) for key in ("survival", "episodes", "unfinished"))
    if not isinstance(survival, (int, float)) or not isinstance(episodes, int) or not isinstance(unfinished, int):
        return _percent(survival)
    ended = episodes - unfinished
    return f"{round(survival * ended)}/{ended}"


def _evaluated(evaluated: Mapping[str, Any]) -> str | None:
    """Return an evaluation's protocol and the surviving share of its first test, ``walk 100.0%``."""
    metrics, protocol = evaluated.get("metrics"), evaluated.get("protocol")
    if not isinstance(metrics, Mapping) or not isinstance(protocol, str):
        return None
    shares = (value for name, value in metrics.items() if str(name).endswith("/survival"))
    return " ".join(filter(None, (protocol, _percent(next(shares, None)))))


def _duration(seconds: float | None) -> str | None:
    if seconds is None:
        return None
    minutes, remainder = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}h{minutes:02}m"
    return f"{minutes}m{remainder:02}s" if minutes else f"{remainder}s"
