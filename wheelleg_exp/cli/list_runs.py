"""``wheelleg list runs`` and ``wheelleg list sweeps``: one line each, and everything with ``--json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.run.listing import RunSummary, SweepSummary, list_runs, list_sweeps
from wheelleg_exp.run.timestamps import utc_text

ROOT = Path("runs")
_NEVER = datetime.min.replace(tzinfo=UTC)  # what stands for an unknown start
_ID_WIDTH = 32

RUN_COLUMNS = ["id", "task", "status", "iterations", "return", "steps", "time-out", "played", "took", "resume"]
SWEEP_COLUMNS = ["id", "status", "jobs", "swept", "took"]

_PROBLEMS_SHOWN = 10

Listed = tuple[list[str], list[list[Any]], list[dict[str, Any]]]


def runs(root: Path | None) -> Listed:
    """Return columns and rows of the runs below ``root``, and the same in full.

    Raises:
        WheellegError: there is no such folder.
    """
    found = list_runs(_folder(root))
    return RUN_COLUMNS, [_run_row(run) for run in found], [_document(run) for run in found]


def sweeps(root: Path | None) -> Listed:
    """Do the same for the sweeps."""
    found = list_sweeps(_folder(root))
    return SWEEP_COLUMNS, [_sweep_row(sweep) for sweep in found], [_document(sweep) for sweep in found]


def problems(documents: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for each run or sweep that says what is wrong with it, the newest ones."""
    lines = [f"{entry['id']}: {entry['problem']}" for entry in documents if entry["problem"]]
    more = len(lines) - _PROBLEMS_SHOWN
    return lines[:_PROBLEMS_SHOWN] + ([f"and {more} more with a problem; --json tells them"] if more > 0 else [])


def _folder(root: Path | None) -> Path:
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
        _shortened(run.id),
        run.task,
        run.status,
        done and done + total,
        _number(run.figures, "return", "{:.2f}"),
        _number(run.figures, "episode_length", "{:.0f}"),
        _number(run.figures, "time_out", "{:.0%}"),
        _number(run.played, "survival", "{:.0%}"),
        _duration(run.seconds),
        ("from start" if run.checkpoint is None else f"from {run.checkpoint}") if run.resumable else None,
    ]


def _sweep_row(sweep: SweepSummary) -> list[Any]:
    jobs = ", ".join(f"{count} {status}" for status, count in sweep.jobs.items())
    took = None if sweep.ended is None else (datetime.fromisoformat(sweep.ended) - sweep.started).total_seconds()
    return [_shortened(sweep.id), sweep.status, jobs or None, " ".join(sweep.swept) or None, _duration(took)]


def _document(summary: RunSummary | SweepSummary) -> dict[str, Any]:
    """Return a summary in full; what a damaged one does not say is left open."""
    started = None if summary.started == _NEVER else utc_text(summary.started)
    document = {**asdict(summary), "started": started}
    return document | {"seeds": list(summary.seeds) or None} if isinstance(summary, RunSummary) else document


def _shortened(text: str) -> str:
    """Return a name that fits its column: the middle gives way, because the end tells runs apart."""
    half = (_ID_WIDTH - 1) // 2
    return text if len(text) <= _ID_WIDTH else f"{text[: _ID_WIDTH - half - 1]}…{text[-half:]}"


def _number(values: Mapping[str, Any], key: str, form: str) -> str | None:
    value = values.get(key)
    return form.format(value) if isinstance(value, (int, float)) else None


def _duration(seconds: float | None) -> str | None:
    if seconds is None:
        return None
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}h{minutes:02}m"
    return f"{minutes}m{rest:02}s" if minutes else f"{rest}s"
