"""The index files of several runs: ``sweep.json`` lists the runs of a sweep, ``pipeline.json`` those of a pipeline.

Each sweep or pipeline has a folder below the folder of all runs. Every change replaces the whole index file.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypedDict

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import json_plain, read_json, write_json
from wheelleg_exp.run.records import read_record
from wheelleg_exp.run.run_directory import (
    PIPELINE_NAME,
    PIPELINES,
    SWEEPS,
    RunDirectory,
    checkpoint_iteration,
    create_exclusively,
)
from wheelleg_exp.run.run_lock import ProcessId, is_alive, this_process
from wheelleg_exp.run.timestamps import folder_text, utc_now, utc_text

SWEEP_NAME, MULTIRUN_NAME = "sweep.json", "multirun.yaml"
_FORMAT = 1
JobStatus = Literal["waiting", "running", "finished", "failed", "interrupted"]
SweepStatus = Literal["finished", "failed", "interrupted"]
PipelineStatus = Literal["finished", "stopped", "failed", "interrupted"]


class JobEntry(TypedDict):
    """A job in ``sweep.json``: its number from 1, all its overrides, and only those that the sweep varies."""

    number: int
    overrides: list[str]
    swept: list[str]
    status: str
    run: str | None
    started: str | None
    ended: str | None
    results: Mapping[str, object]
    error: object


class _Launcher(TypedDict):
    name: str
    at_once: int


class _SweepData(TypedDict):
    status: str
    working_directory: str
    launcher: _Launcher
    jobs: list[JobEntry]
    process: ProcessId | None


class _Reasons(TypedDict, total=False):
    why: list[str]


class GateEntry(_Reasons):
    """The evaluation after ``iteration`` iterations that decides whether a phase has passed."""

    iteration: int
    passed: bool


class _PhaseTimes(TypedDict, total=False):
    started: str | None
    ended: str | None


class PhaseEntry(_PhaseTimes):
    """A phase in ``pipeline.json``.

    ``why`` is the reason to continue or to stop after the phase, ``digest`` a hash of the phase's config, and
    ``trained`` the number of finished iterations. ``run`` and ``init_from`` are relative to the pipeline's folder.
    """

    name: str
    status: str
    digest: str
    trained: int
    why: str | None
    run: str | None
    init_from: str | None
    gates: list[GateEntry]


class _PipelineConfig(TypedDict):
    phases: Mapping[str, object]


class _PipelineData(TypedDict):
    id: str
    name: str
    status: str
    root: str
    started: str
    why: str | None
    config_dirs: list[str]
    overrides: list[str]
    resumes: list[Mapping[str, object]]
    config: _PipelineConfig
    phases: list[PhaseEntry]
    process: ProcessId | None


@dataclass
class _RunIndex:
    folder: Path
    data: dict[str, Any]

    DATA: ClassVar[type]
    KIND: ClassVar[str]
    ENTRIES: ClassVar[str]
    FILE: ClassVar[str]
    SECTION: ClassVar[str]

    @classmethod
    def _create(cls, below: str | Path, command: Sequence[str], moment: datetime | None, **more: object) -> Self:
        """Create the folder ``<below>/<section>/<time>`` and the index file; ``more`` are keys of one kind of index."""
        moment = moment or utc_now()
        folder = create_exclusively(Path(below) / cls.SECTION, folder_text(moment))
        data = {
            "format": _FORMAT,
            "id": folder.name,
            "status": "running",
            "command": list(command),
            "working_directory": str(Path.cwd()),
            "started": utc_text(moment),
            "ended": None,
            "process": this_process(),
            **more,
        }
        index = cls(folder, data)
        index.write()
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
        read_record(cls.DATA, data, f"{cls.FILE} is damaged", path)
        return cls(path.parent.resolve(), data)

    def require_ended(self) -> None:
        """Raise RunDirectoryError if the process that wrote the index still runs."""
        if self.data["status"] == "running" and is_alive(self.data["process"]):
            message, expected = f"this {self.KIND} is still running", "one that has ended: wait for it"
            raise RunDirectoryError(message, key=str(self.path), expected=expected)

    def require_inside(self, path: Path) -> None:
        """Raise RunDirectoryError if ``path`` is outside the folder of runs that contains this index."""
        root = self.folder.parents[1]
        if not Path(os.path.normpath(self.folder / path)).is_relative_to(root):
            message = f"the {self.KIND} names '{path}'"
            raise RunDirectoryError(message, where=str(self.path), expected=f"a path below {root}")

    @property
    def path(self) -> Path:
        return self.folder / self.FILE

    def run_of(self, entry: JobEntry | PhaseEntry) -> Path | None:
        """Return the absolute run directory of a sweep job or pipeline phase; None if its training has not started."""
        return None if entry["run"] is None else Path(os.path.normpath(self.folder / entry["run"]))

    def relative(self, path: Path) -> str:
        return Path(os.path.relpath(path, self.folder)).as_posix()

    def write(self) -> None:
        write_json(self.path, self.data)


class SweepIndex(_RunIndex):
    """The index of one sweep.

    ``status`` is ``running``, ``finished``, ``interrupted``, or ``failed`` if a job did not finish. A job that never
    started is ``waiting``. The ``run`` of a job is relative to the sweep's folder.
    """

    DATA, KIND, ENTRIES, FILE, SECTION = _SweepData, "sweep", "jobs", SWEEP_NAME, SWEEPS

    @classmethod
    def create(
        cls,
        root: str | Path,
        *,
        command: Sequence[str],
        launcher: Mapping[str, object],
        jobs: Sequence[tuple[Sequence[str], Sequence[str]]],
        now: datetime | None = None,
    ) -> SweepIndex:
        """Create the folder and the index file of a new sweep below ``root``, the folder of all runs.

        ``jobs`` contains two lists per job: all of its config overrides, and only the overrides that the sweep varies.
        """
        entries = [
            JobEntry(
                number=number,
                overrides=list(overrides),
                swept=list(swept),
                status="waiting",
                run=None,
                started=None,
                ended=None,
                results={},
                error=None,
            )
            for number, (overrides, swept) in enumerate(jobs, 1)
        ]
        return cls._create(root, command, now, jobs=entries, launcher=dict(launcher))

    @property
    def jobs(self) -> list[JobEntry]:
        found: list[JobEntry] = self.data["jobs"]
        return found

    def unfinished(self) -> list[JobEntry]:
        return [job for job in self.jobs if job["status"] != "finished"]

    def restart(self) -> None:
        """Record that the running process resumes the sweep, whose unfinished jobs wait again."""
        for job in self.unfinished():
            job["status"], job["ended"], job["error"] = "waiting", None, None
        self.data |= {"status": "running", "ended": None, "process": this_process()}
        self.write()

    def finish(self, status: SweepStatus) -> None:
        """Record how the sweep ended; a job without a recorded end counts as interrupted."""
        for job in self.jobs:
            if job["status"] == "running":
                job["status"], job["ended"] = "interrupted", utc_text(utc_now())
        self.data |= {"status": status, "ended": utc_text(utc_now())}
        self.write()

    def update(self, number: int, **changes: object) -> None:
        self.data["jobs"][number - 1].update(changes)
        self.write()


class PipelineIndex(_RunIndex):
    """The index of one pipeline.

    ``status`` is ``running``, ``finished``, ``failed``, ``interrupted``, or ``stopped`` if a phase did not pass.
    """

    DATA, KIND, ENTRIES, FILE, SECTION = _PipelineData, "pipeline", "phases", PIPELINE_NAME, PIPELINES

    @classmethod
    def create(
        cls,
        root: str | Path,
        *,
        config: Mapping[str, object],
        overrides: Sequence[str],
        config_dirs: Sequence[Path],
        command: Sequence[str],
        digests: Mapping[str, str],
    ) -> PipelineIndex:
        """Create the folder and the index file of a new pipeline below ``root``, the folder of all runs.

        ``overrides`` apply to all training phases. ``digests`` maps each phase to a hash of its config.
        """
        phases = [
            PhaseEntry(
                name=name,
                status="waiting",
                why=None,
                digest=digest,
                run=None,
                init_from=None,
                trained=0,
                gates=[],
                started=None,
                ended=None,
            )
            for name, digest in digests.items()
        ]
        return cls._create(
            root,
            command,
            None,
            phases=phases,
            name=config["name"],
            why=None,
            config_dirs=[str(folder) for folder in config_dirs],
            root="../..",
            overrides=list(overrides),
            resumes=[],
            config=json_plain(config),
        )

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read a pipeline's index file from a folder, and check that all its runs are in its folder of runs."""
        index = super().load(folder)
        for path in (index.root, *filter(None, map(index.run_of, index.phases))):
            index.require_inside(path)
        return index

    @property
    def root(self) -> Path:
        return Path(os.path.normpath(self.folder / self.data["root"]))

    @property
    def phases(self) -> list[PhaseEntry]:
        found: list[PhaseEntry] = self.data["phases"]
        return found

    def done(self, phase: PhaseEntry) -> int:
        """Return the number of finished training iterations of a pipeline phase, even after an interruption."""
        run, last = self.run_of(phase), 0
        if run is not None:
            with suppress(RunDirectoryError):
                last = checkpoint_iteration(RunDirectory(run).latest_checkpoint()) + 1
        return max(phase["trained"], last)

    def update(self, phase: PhaseEntry, **changes: object) -> None:
        entry = next(other for other in self.data["phases"] if other["name"] == phase["name"])
        entry.update(json_plain(changes))
        self.write()

    def restart(
        self, command: Sequence[str], changes: Sequence[Mapping[str, object]], config: Mapping[str, object]
    ) -> None:
        """Record that the running process resumes the pipeline, and record which pipeline settings changed."""
        before = {key: self.data[key] for key in ("status", "why", "ended", "process")}
        entry = {"when": utc_text(utc_now()), "command": list(command), "changes": list(changes), "before": before}
        self.data["resumes"].append(json_plain(entry))
        self.data |= {"status": "running", "why": None, "ended": None, "process": this_process()}
        self.data["config"] = json_plain(config)
        self.write()

    def finish(self, status: PipelineStatus, why: str | None) -> None:
        self.data |= {"status": status, "why": why, "ended": utc_text(utc_now())}
        self.write()
