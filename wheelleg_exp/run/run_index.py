"""The index files of several runs: ``sweep.json`` lists the runs of a sweep, ``pipeline.json`` those of a pipeline.

Each sweep or pipeline has a folder below the folder of all runs; its index file lists the paths of run directories.
Every change replaces the whole index file of the sweep or pipeline.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

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

SWEEP_NAME, MULTIRUN_NAME = "sweep.json", "multirun.yaml"
_FORMAT = 1
_PHASE_TYPES: dict[str, Any] = dict.fromkeys(("name", "status", "digest"), str) | {"trained": int}
_PHASE_TYPES |= {**dict.fromkeys(("why", "run", "init_from"), Optional(str))}
_PHASE_TYPES |= {"gates": [{"iteration": int, "passed": bool}]}
_PIPELINE_TYPES: dict[str, Any] = dict.fromkeys(("id", "name", "status", "root", "started"), str)
_PIPELINE_TYPES |= {"why": Optional(str), "config_dirs": [str], "overrides": [str], "resumes": [dict]}
_PIPELINE_TYPES |= {"config": {"phases": dict}, "phases": [_PHASE_TYPES]}

JobStatus = Literal["waiting", "running", "finished", "failed", "interrupted"]
SweepStatus = Literal["finished", "failed", "interrupted"]
PipelineStatus = Literal["finished", "stopped", "failed", "interrupted"]


@dataclass
class _RunIndex:
    """One index file: its absolute folder, and its content."""

    folder: Path
    data: dict[str, Any] = field(default_factory=dict)

    KIND: ClassVar[str]
    ENTRIES: ClassVar[str]
    FILE: ClassVar[str]
    SECTION: ClassVar[str]

    @classmethod
    def _create(
        cls, root: str | Path, command: Sequence[str], moment: datetime | None, entries: list[dict[str, Any]]
    ) -> Self:
        """Create the folder ``<root>/<section>/<time>``, and set the keys of ``data`` that all index files have."""
        moment = moment or utc_now()
        index = cls(create_exclusively(Path(root) / cls.SECTION, folder_text(moment)))
        index.data = {
            "format": _FORMAT,
            "id": index.folder.name,
            "status": "running",
            "command": list(command),
            "working_directory": str(Path.cwd()),
            "started": utc_text(moment),
            "ended": None,
            "process": this_process(),
            cls.ENTRIES: entries,
        }
        return index

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read the index file in a folder; raise RunDirectoryError for a missing, damaged, or unknown index file."""
        path = Path(folder) / cls.FILE
        data = read_json(path)
        if not isinstance(data, dict) or not isinstance(data.get(cls.ENTRIES), list):
            expected = f"a mapping with '{cls.ENTRIES}'"
            raise RunDirectoryError(f"the file is not the index of a {cls.KIND}", where=str(path), expected=expected)
        if data.get("format") != _FORMAT:
            message = f"{cls.KIND} format {data.get('format')!r} is unknown"
            raise RunDirectoryError(message, where=str(path), expected=f"format {_FORMAT}")
        return cls(path.parent.resolve(), data)

    @property
    def path(self) -> Path:
        """The index file."""
        return self.folder / self.FILE

    def run_of(self, entry: Mapping[str, Any]) -> Path | None:
        """Return the absolute run directory of a sweep job or pipeline phase; None if its training has not started."""
        return None if entry["run"] is None else Path(os.path.normpath(self.folder / entry["run"]))

    def relative(self, path: Path) -> str:
        """Return a run directory's path relative to the folder of the index file."""
        return Path(os.path.relpath(path, self.folder)).as_posix()

    def write(self) -> None:
        """Replace the index file."""
        write_json(self.path, self.data)


class SweepIndex(_RunIndex):
    """The index of one sweep.

    The index file ``sweep.json`` contains the sweep's command, start and end time, process, launcher, status, and jobs.
    A sweep's ``status`` is ``running``, ``finished``, ``interrupted``, or ``failed`` if a job did not finish. A job's
    ``number`` counts from 1. A job's ``overrides`` are all of its config overrides, and ``swept`` contains only those
    that the sweep varies. A job's ``run`` is its run directory, as a path relative to the sweep's folder. A job that
    never started has the status ``waiting``.
    """

    KIND, ENTRIES, FILE, SECTION = "sweep", "jobs", SWEEP_NAME, SWEEPS

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
        """Create the folder and the index file of a new sweep below ``root``, the folder of all runs.

        ``jobs`` contains two lists per job: all of its config overrides, and only the overrides that the sweep varies.
        """
        entries: list[dict[str, Any]] = []
        for number, (overrides, swept) in enumerate(jobs, 1):
            entry = {"number": number, "overrides": list(overrides), "swept": list(swept), "status": "waiting"}
            entries.append({**entry, "run": None, "started": None, "ended": None, "results": {}, "error": None})
        index = cls._create(root, command, now, entries)
        index.data["launcher"] = dict(launcher)
        index.write()
        return index

    @property
    def jobs(self) -> list[dict[str, Any]]:
        """The jobs in order."""
        return self.data["jobs"]

    def write_multirun(self, text: str) -> None:
        """Write the config that Hydra composed for the whole sweep."""
        write_text(self.folder / MULTIRUN_NAME, text)

    def job_started(self, number: int) -> None:
        """Record that a job of the sweep has started."""
        self._update_job(number, status="running", started=utc_text(utc_now()))

    def job_has_run(self, number: int, run: Path) -> None:
        """Record the run directory of a sweep job in the sweep's index."""
        self._update_job(number, run=self.relative(run))

    def job_ended(self, number: int, status: JobStatus, results: Mapping[str, Any], error: Any = None) -> None:
        """Record how a job ended."""
        self._update_job(number, status=status, ended=utc_text(utc_now()), results=dict(results), error=error)

    def finish(self, status: SweepStatus) -> None:
        """Record how the sweep ended; a job without a recorded end counts as interrupted."""
        for job in self.jobs:
            if job["status"] == "running":
                job |= {"status": "interrupted", "ended": utc_text(utc_now())}
        self.data |= {"status": status, "ended": utc_text(utc_now())}
        self.write()

    def _update_job(self, number: int, **changes: Any) -> None:
        self.jobs[number - 1].update(changes)
        self.write()


class PipelineIndex(_RunIndex):
    """The index of one pipeline.

    The index file ``pipeline.json`` contains the pipeline's command, config, overrides for all phases, and resumes. A
    pipeline's ``status`` is ``running``, ``finished``, ``failed``, ``interrupted``, or ``stopped`` if a phase did not
    pass. A phase's ``why`` is the reason to continue or to stop the pipeline after the phase. A phase's ``digest`` is a
    hash of the phase's config. The run directories ``run`` and ``init_from`` of a pipeline phase are paths relative to
    the pipeline's folder. ``trained`` is the number of finished training iterations of a pipeline phase. ``gates`` are
    the evaluation results that decide whether a pipeline phase passed.
    """

    KIND, ENTRIES, FILE, SECTION = "pipeline", "phases", PIPELINE_NAME, PIPELINES

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
    ) -> PipelineIndex:
        """Create the folder and the index file of a new pipeline below ``root``, the folder of all runs.

        ``config`` is the pipeline's config as JSON values. ``overrides`` apply to all training phases. ``digests`` maps
        the name of each training phase to a hash of the phase's config.
        """
        phases: list[dict[str, Any]] = []
        for name, digest in digests.items():
            entry = {"name": name, "status": "waiting", "why": None, "digest": digest, "run": None, "init_from": None}
            phases.append({**entry, "trained": 0, "gates": [], "started": None, "ended": None})
        index = cls._create(root, command, None, phases)
        index.data |= {
            "name": config["name"],
            "why": None,
            "config_dirs": [str(folder) for folder in config_dirs],
            "root": os.path.relpath(Path(root).resolve(), index.folder),
            "overrides": list(overrides),
            "resumes": [],
            "config": json_plain(config),
        }
        index.write()
        return index

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read a pipeline's index file from a folder, and check the type of each value in the index file."""
        index = super().load(folder)
        where, phases = str(index.path), [phase if isinstance(phase, dict) else {} for phase in index.phases]
        missing = [key for key in _PIPELINE_TYPES if key not in index.data]
        missing += [f"phases.{key}" for phase in phases for key in _PHASE_TYPES if key not in phase]
        if missing:
            message, expected = f"the key '{missing[0]}' is missing", ", ".join(_PIPELINE_TYPES)
            raise RunDirectoryError(f"pipeline.json is damaged: {message}", where=where, expected=expected)
        for key in mistyped_keys(index.data, {**_PIPELINE_TYPES, "process": Optional(WRITER)}):
            raise RunDirectoryError(f"pipeline.json is damaged: the key '{key}' is missing or wrong", where=where)
        for path in (index.root, *filter(None, map(index.run_of, phases))):
            index.require_inside(path)
        return index

    def require_inside(self, path: Path) -> None:
        """Raise RunDirectoryError if ``path`` is outside the folder of runs that contains this pipeline."""
        root = self.folder.parents[1]
        if not Path(os.path.normpath(self.folder / path)).is_relative_to(root):
            message = f"the pipeline names '{path}'"
            raise RunDirectoryError(message, where=str(self.path), expected=f"a path below {root}")

    @property
    def root(self) -> Path:
        """The folder of all runs."""
        return Path(os.path.normpath(self.folder / self.data["root"]))

    @property
    def phases(self) -> list[dict[str, Any]]:
        """The phases in order."""
        return self.data["phases"]

    def done(self, phase: Mapping[str, Any]) -> int:
        """Return the number of finished training iterations of a pipeline phase, even after an interruption."""
        run, last = self.run_of(phase), 0
        if run is not None:
            with suppress(RunDirectoryError):
                last = checkpoint_iteration(RunDirectory(run).latest_checkpoint()) + 1
        return max(int(phase["trained"]), last)

    def update(self, phase: Mapping[str, Any], **changes: Any) -> None:
        """Write the changed values of one pipeline phase into the pipeline's index file."""
        number = next(i for i, other in enumerate(self.phases) if other["name"] == phase["name"])
        self.phases[number].update(json_plain(changes))
        self.write()

    def restart(self, command: Sequence[str], changes: Sequence[Mapping[str, Any]], config: Mapping[str, Any]) -> None:
        """Record that the running process resumes the pipeline, and record which pipeline settings changed."""
        before = {key: self.data[key] for key in ("status", "why", "ended", "process")}
        entry = {"when": utc_text(utc_now()), "command": list(command), "changes": list(changes), "before": before}
        self.data["resumes"].append(json_plain(entry))
        self.data |= {"status": "running", "why": None, "ended": None, "process": this_process()}
        self.data["config"] = json_plain(config)
        self.write()

    def finish(self, status: PipelineStatus, why: str | None) -> None:
        """Record how the pipeline ended."""
        self.data |= {"status": status, "why": why, "ended": utc_text(utc_now())}
        self.write()


def find_pipeline(named: str | Path, root: str | Path) -> Path | None:
    """Find a pipeline's folder by its path, or by the pipeline's id below ``root``; None if there is no pipeline."""
    for folder in (Path(named), Path(root) / PIPELINES / str(named), Path(root) / str(named)):
        if is_pipeline(folder):
            return folder.resolve()
    path = Path(named)
    return path.parent.resolve() if path.name == PIPELINE_NAME and is_pipeline(path.parent) else None


def pipelines_below(root: Path) -> list[PipelineIndex]:
    """Return the pipelines in a folder of runs, the newest first; skip pipelines with a damaged index file."""
    found = []
    for path in sorted((root / PIPELINES).glob(f"*/{PIPELINE_NAME}"), reverse=True):
        with suppress(RunDirectoryError):
            found.append(PipelineIndex.load(path.parent))
    return found
