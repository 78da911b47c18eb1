"""All the runs there are, with what became of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.directory import run_folders, start_moment
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.process import is_alive

CRASHED = "crashed"
DAMAGED = "damaged"


@dataclass(frozen=True)
class RunSummary:
    """One line of the list of runs.

    ``status`` is the manifest's, or ``crashed`` (it says running, and its process is gone), or ``damaged``
    (the manifest cannot be read; ``problem`` says why).
    """

    id: str
    task: str
    status: str
    path: Path
    started: datetime
    ended: str | None = None
    seeds: tuple[int, ...] = ()
    results: dict[str, Any] = field(default_factory=dict)
    problem: str | None = None


def list_runs(root: str | Path) -> list[RunSummary]:
    """Return a summary of every run below ``root``, the newest first; no root is no runs."""
    summaries = [summarize(folder) for folder in run_folders(Path(root))]
    return sorted(summaries, key=lambda s: (s.started, s.id), reverse=True)


def summarize(folder: Path) -> RunSummary:
    """Return the summary of one run directory; a damaged one is said to be so, not raised."""
    try:
        manifest = Manifest.load(folder)
    except RunDirectoryError as error:
        return RunSummary(folder.name, folder.parent.name, DAMAGED, folder, start_moment(folder), problem=str(error))
    data = manifest.data
    return RunSummary(
        id=folder.name,
        task=data["task"],
        status=effective_status(manifest),
        path=folder,
        started=manifest.started,
        ended=data["ended"],
        seeds=tuple(data.get("seeds", ())),
        results=manifest.results,
        problem=(data.get("error") or {}).get("message"),
    )


def effective_status(manifest: Manifest) -> str:
    """Return the manifest's status, or ``crashed`` when it says running and its process is gone."""
    if manifest.status == "running" and is_alive(manifest.data.get("process") or {}) is False:
        return CRASHED
    return manifest.status
