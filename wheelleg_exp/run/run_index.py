"""The indexes of several runs: ``sweep.json`` of a sweep and ``pipeline.json`` of a pipeline.

Both point to ordinary run directories. Every change replaces the whole file.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import json_plain, read_json, write_json, write_text
from wheelleg_exp.run.manifest import WRITER, Optional, mistyped_keys
from wheelleg_exp.run.run_directory import (
    PIPELINE_NAME,
    PIPELINES,
    SWEEPS,
    RunDirectory,
    checkpoint_iteration,
    create_exclusively,
    is_pipeline,
)
from wheelleg_exp.run.run_lock import this_process
from wheelleg_exp.run.timestamps import folder_text, utc_now, utc_text

SWEEP_NAME = "sweep.json"
MULTIRUN_NAME = "multirun.yaml"
SWEEP_FORMAT = 1

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
            "format": SWEEP_FORMAT,
            "id": index.folder.name,
            "status": "running",
            "command": list(command),
            "working_directory": str(Path.cwd()),
            "started": utc_text(moment),
            "ended": None,
            "process": this_process(),
            "launcher": dict(launcher),
            "jobs": [_waiting_job(number, *job) for number, job in enumerate(jobs, 1)],
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
        if data.get("format") != SWEEP_FORMAT:
            message = f"sweep format {data.get('format')!r} is not known here"
            raise RunDirectoryError(message, where=str(path), expected=f"format {SWEEP_FORMAT}")
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


def _waiting_job(number: int, overrides: Sequence[str], swept: Sequence[str]) -> dict[str, Any]:
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


PIPELINE_FORMAT = 1
_PHASE_TYPES: dict[str, Any] = dict.fromkeys(("name", "status", "digest"), str) | {"trained": int}
_PHASE_TYPES |= {
    **dict.fromkeys(("why", "run", "init_from"), Optional(str)),
    "gates": [{"iteration": int, "passed": bool}],
}
_PIPELINE_TYPES: dict[str, Any] = dict.fromkeys(("id", "name", "status", "root", "started"), str) | {
    "why": Optional(str)
}
_PIPELINE_TYPES |= {
    "config_dirs": [str],
    "overrides": [str],
    "resumes": [dict],
    "config": {"phases": dict},
    "phases": [_PHASE_TYPES],
}

PhaseStatus = Literal["waiting", "training", "passed", "failed"]
PipelineStatus = Literal["finished", "stopped", "failed", "interrupted"]


@dataclass
class PipelineIndex:
    """The record of one pipeline; every change replaces the whole file.

    ``data`` holds ``format``, ``id``, ``name``, ``status`` (``running``, ``finished``, ``stopped`` at a gate that was
    not passed, ``failed``, ``interrupted``), ``why``, ``command``, ``working_directory``, ``config_dirs``, ``root``,
    ``overrides`` (for all phases), ``started``, ``ended``, ``process``, ``resumes``, ``config`` (the declared pipeline)
    and ``phases``. A phase has ``name``, ``status``, ``why`` (it went on, or did not), ``digest`` (of its config),
    ``run`` (relative to the record), ``init_from`` (likewise), ``trained`` (iterations that are known to be done),
    ``gates`` (what each evaluation found), ``started`` and ``ended``.
    """

    folder: Path
    data: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def create(
        cls,
        root: str | Path,
        *,
        config: Mapping[str, Any],
        overrides: Sequence[str],
        config_dirs: Sequence[Path],
        command: Sequence[str],
        digests: Mapping[str, str],
        now: datetime | None = None,
    ) -> PipelineIndex:
        """Make the folder of a new pipeline and write its record; no phase has begun.

        Args:
            root: the folder of all runs.
            config: the declared pipeline, plain.
            overrides: those of the command line, for all phases.
            config_dirs: the user's config folders.
            command: the command line.
            digests: digest of each phase's config, by its name.
            now: the time of the start, by default the present.

        Raises:
            RunDirectoryError: the folder cannot be made or written.
        """
        moment = now or utc_now()
        index = cls(create_exclusively(Path(root) / PIPELINES, folder_text(moment)))
        index.data = {
            "format": PIPELINE_FORMAT,
            "id": index.folder.name,
            "name": config["name"],
            "status": "running",
            "why": None,
            "command": list(command),
            "working_directory": str(Path.cwd()),
            "config_dirs": [str(folder) for folder in config_dirs],
            "root": os.path.relpath(Path(root).resolve(), index.folder),
            "overrides": list(overrides),
            "started": utc_text(moment),
            "ended": None,
            "process": this_process(),
            "resumes": [],
            "config": json_plain(config),
            "phases": [_waiting_phase(name, digest) for name, digest in digests.items()],
        }
        index.write()
        return index

    @classmethod
    def load(cls, folder: str | Path) -> PipelineIndex:
        """Read the record in a pipeline's folder.

        Raises:
            RunDirectoryError: there is none, it is broken, or its format is not known here.
        """
        path = Path(folder) / PIPELINE_NAME
        data = read_json(path)
        if not isinstance(data, dict) or not isinstance(data.get("phases"), list):
            raise RunDirectoryError("this is no pipeline's record", where=str(path), expected="a mapping with 'phases'")
        if data.get("format") != PIPELINE_FORMAT:
            message = f"pipeline format {data.get('format')!r} is not known here"
            raise RunDirectoryError(message, where=str(path), expected=f"format {PIPELINE_FORMAT}")
        phases = [phase if isinstance(phase, dict) else {} for phase in data["phases"]]
        missing = [key for key in _PIPELINE_TYPES if key not in data]
        missing += [f"phases.{key}" for phase in phases for key in _PHASE_TYPES if key not in phase]
        if missing:
            raise RunDirectoryError(
                f"this record lacks {missing[0]}", where=str(path), expected=", ".join(_PIPELINE_TYPES)
            )
        for wrong in mistyped_keys(data, {**_PIPELINE_TYPES, "process": Optional(WRITER)}):
            raise RunDirectoryError(f"broken record: '{wrong}' is missing or wrong", where=str(path))
        return cls(path.parent.resolve(), data)

    @property
    def path(self) -> Path:
        """The record."""
        return self.folder / PIPELINE_NAME

    @property
    def root(self) -> Path:
        """The folder of all runs."""
        return Path(os.path.normpath(self.folder / self.data["root"]))

    @property
    def phases(self) -> list[dict[str, Any]]:
        """The phases, in order."""
        return self.data["phases"]

    def run_of(self, phase: Mapping[str, Any]) -> Path | None:
        """Return the run directory of a phase, absolute; None as long as it has none."""
        return None if phase["run"] is None else Path(os.path.normpath(self.folder / phase["run"]))

    def done(self, phase: Mapping[str, Any]) -> int:
        """Return how many iterations a phase has done, those of a step that was stopped among them."""
        run, last = self.run_of(phase), 0
        if run is not None:
            with suppress(RunDirectoryError):
                last = checkpoint_iteration(RunDirectory(run).latest_checkpoint()) + 1
        return max(int(phase["trained"]), last)

    def relative(self, path: Path) -> str:
        """Return a path as the record names it."""
        return Path(os.path.relpath(path, self.folder)).as_posix()

    def update(self, phase: Mapping[str, Any], **changes: Any) -> None:
        """Record what has become of a phase."""
        number = next(i for i, other in enumerate(self.phases) if other["name"] == phase["name"])
        self.phases[number].update(json_plain(changes))
        self.write()

    def restart(self, command: Sequence[str], changes: Sequence[Mapping[str, Any]], config: Mapping[str, Any]) -> None:
        """Record that it goes on, in this process, with settings that may have changed."""
        before = {key: self.data[key] for key in ("status", "why", "ended", "process")}
        entry = {"when": utc_text(utc_now()), "command": list(command), "changes": list(changes), "before": before}
        self.data["resumes"].append(json_plain(entry))
        self.data |= {"status": "running", "why": None, "ended": None, "process": this_process()}
        self.data["config"] = json_plain(config)
        self.write()

    def finish(self, status: PipelineStatus, why: str | None) -> None:
        """Record how it ended."""
        self.data |= {"status": status, "why": why, "ended": utc_text(utc_now())}
        self.write()

    def write(self) -> None:
        """Replace the file."""
        write_json(self.path, self.data)


def find_pipeline(named: str | Path, root: str | Path) -> Path | None:
    """Return the folder of the pipeline that a path, or an id below ``root``, names; None where it names none."""
    for folder in (Path(named), Path(root) / PIPELINES / str(named), Path(root) / str(named)):
        if is_pipeline(folder):
            return folder.resolve()
    path = Path(named)
    return path.parent.resolve() if path.name == PIPELINE_NAME and is_pipeline(path.parent) else None


def pipelines_below(root: Path) -> list[PipelineIndex]:
    """Return the pipelines that were begun below a folder of runs, the newest first; damaged records are left out."""
    found = []
    for path in sorted((root / PIPELINES).glob(f"*/{PIPELINE_NAME}"), reverse=True):
        with suppress(RunDirectoryError):
            found.append(PipelineIndex.load(path.parent))
    return found


def _waiting_phase(name: str, digest: str) -> dict[str, Any]:
    return {
        "name": name,
        "status": "waiting",
        "why": None,
        "digest": digest,
        "run": None,
        "init_from": None,
        "trained": 0,
        "gates": [],
        "started": None,
        "ended": None,
    }
