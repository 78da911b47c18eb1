"""The index of a sweep: ``<root>/sweeps/<time>/{sweep.json,multirun.yaml}``, which points to ordinary runs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json, write_json, write_text
from wheelleg_exp.run.directory import SWEEPS, create_exclusively
from wheelleg_exp.run.process import this_process
from wheelleg_exp.run.timestamps import folder_text, utc_now, utc_text

SWEEP_NAME = "sweep.json"
MULTIRUN_NAME = "multirun.yaml"
FORMAT = 1

JobStatus = Literal["waiting", "running", "finished", "failed", "interrupted"]
SweepStatus = Literal["finished", "failed", "interrupted"]


@dataclass
class SweepIndex:
    """The index of one sweep; every change replaces the whole file.

    ``data`` holds ``format``, ``id``, ``status`` (``running``, ``finished``, ``failed`` when a job did not
    finish, ``interrupted``), ``command``, ``working_directory``, ``started``, ``ended``, ``process``,
    ``launcher`` and ``jobs``. A job has ``number`` (from 1), ``overrides`` (what trains it alone), ``swept``
    (those in which the jobs differ), ``status``, ``run`` (relative to the index), ``started``, ``ended``,
    ``results`` (the run's own) and ``error``. A job that never began keeps the status ``waiting``.
    """

    folder: Path
    data: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def create(
        cls,
        root: str | Path,
        *,
        command: Sequence[str],
        launcher: Mapping[str, Any],
        jobs: Sequence[tuple[Sequence[str], Sequence[str]]],
        now: datetime | None = None,
    ) -> SweepIndex:
        """Make the folder of a new sweep and write its index; no job has begun.

        Args:
            root: the folder of all runs.
            command: the command line.
            launcher: the launcher's name and how many jobs run at once.
            jobs: overrides of each job, and those of them that are swept.
            now: the time of the start, by default the present.

        Raises:
            RunDirectoryError: the folder cannot be made or written.
        """
        moment = now or utc_now()
        index = cls(create_exclusively(Path(root) / SWEEPS, folder_text(moment)))
        index.data = {
            "format": FORMAT,
            "id": index.folder.name,
            "status": "running",
            "command": list(command),
            "working_directory": str(Path.cwd()),
            "started": utc_text(moment),
            "ended": None,
            "process": this_process(),
            "launcher": dict(launcher),
            "jobs": [_waiting(number, *job) for number, job in enumerate(jobs, 1)],
        }
        index._write()
        return index

    @classmethod
    def load(cls, folder: str | Path) -> SweepIndex:
        """Read the index in a sweep's folder.

        Raises:
            RunDirectoryError: there is none, it is broken, or its format is not known here.
        """
        path = Path(folder) / SWEEP_NAME
        data = read_json(path)
        if not isinstance(data, dict) or not isinstance(data.get("jobs"), list):
            raise RunDirectoryError("this is not a sweep's index", where=str(path), expected="a mapping with 'jobs'")
        if data.get("format") != FORMAT:
            message = f"sweep format {data.get('format')!r} is not known here"
            raise RunDirectoryError(message, where=str(path), expected=f"format {FORMAT}")
        return cls(path.parent, data)

    @property
    def path(self) -> Path:
        """The index file."""
        return self.folder / SWEEP_NAME

    @property
    def jobs(self) -> list[dict[str, Any]]:
        """The jobs, in order."""
        return self.data["jobs"]

    def run_of(self, job: Mapping[str, Any]) -> Path | None:
        """Return the run directory of a job, absolute; None as long as it has none."""
        return None if job["run"] is None else Path(os.path.normpath(self.folder / job["run"]))

    def write_multirun(self, text: str) -> None:
        """Write Hydra's config of the whole sweep."""
        write_text(self.folder / MULTIRUN_NAME, text)

    def job_started(self, number: int) -> None:
        """Record that a job began."""
        self._update_job(number, status="running", started=utc_text(utc_now()))

    def job_has_run(self, number: int, run: Path) -> None:
        """Record which run directory a job writes."""
        self._update_job(number, run=Path(os.path.relpath(run, self.folder)).as_posix())

    def job_ended(self, number: int, status: JobStatus, results: Mapping[str, Any], error: Any = None) -> None:
        """Record how a job ended."""
        self._update_job(number, status=status, ended=utc_text(utc_now()), results=dict(results), error=error)

    def finish(self, status: SweepStatus) -> None:
        """Record how the sweep ended; a job that nobody saw end counts as interrupted."""
        for job in self.jobs:
            if job["status"] == "running":
                job |= {"status": "interrupted", "ended": utc_text(utc_now())}
        self.data |= {"status": status, "ended": utc_text(utc_now())}
        self._write()

    def _update_job(self, number: int, **changes: Any) -> None:
        self.jobs[number - 1].update(changes)
        self._write()

    def _write(self) -> None:
        write_json(self.path, self.data)


def _waiting(number: int, overrides: Sequence[str], swept: Sequence[str]) -> dict[str, Any]:
    return {
        "number": number,
        "overrides": list(overrides),
        "swept": list(swept),
        "status": "waiting",
        "run": None,
        "started": None,
        "ended": None,
        "results": {},
        "error": None,
    }
