"""The run or agent's run of a report: its files, read as far as possible."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeGuard, TypeVar

from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.files import read_json, read_lines, read_yaml
from wheelleg_exp.packages import own_folders
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import read_line
from wheelleg_exp.run.records import Addition, RunRecord
from wheelleg_exp.run.run_config import OVERRIDES, PARTS
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_list import effective_status

AGENT = "agent"
KIND = "report"  # A run's manifest lists each report about the run as an entry of the kind ``report``.
_FIGURES, _SETTINGS = "figures.json", "config.yaml"
_NO_RECORD = RunRecord(status=AGENT, task="", started="", results={}, resumes=(), additions=(), files={})

T = TypeVar("T")


@dataclass(frozen=True)
class Series:
    """One training scalar; ``values[i]`` is the scalar's value at the training iteration ``at[i]``."""

    at: tuple[int, ...]
    values: tuple[float, ...]


@dataclass
class Subject:
    """The subject of a report: one training run, or one run of a zero or random agent."""

    path: Path
    run: RunDirectory | None  # ``run`` is None for a zero or random agent's run, which has no manifest.
    manifest: RunRecord = _NO_RECORD
    status: str = AGENT  # The status ``agent`` means a zero or random agent's run.
    config: Mapping[str, object] = field(default_factory=dict)  # The run's sections ``env`` and ``agent``.
    overrides: list[str] | None = None  # None means that the user's Hydra overrides are unknown.
    choices: Mapping[str, object] = field(default_factory=dict)  # The selected option of each Hydra config group.
    config_dirs: tuple[Path, ...] = ()
    scalars: dict[str, Series] = field(default_factory=dict)
    agent_figures: Mapping[str, object] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)  # ``problems`` contains sentences about unreadable files.

    @property
    def id(self) -> str:
        return self.path.name

    @property
    def task(self) -> str:
        return self.manifest.task or self.path.parent.name

    @property
    def step_s(self) -> float | None:
        """The duration of a control step, s; None if the run's config does not contain the duration."""
        dt, decimation = self.setting("env.sim.dt"), self.setting("env.decimation")
        return dt * decimation if is_number(dt) and is_number(decimation) else None

    def setting(self, path: str) -> object:
        """Return the value of a dotted key in the run's config; None if the config lacks the key."""
        return at(self.config, path)

    def last(self, name: str) -> float | None:
        """Return the last value of a training scalar; None if the run did not log the scalar."""
        series = self.scalars.get(name)
        return series.values[-1] if series and series.values else None

    def additions(self, kind: str) -> list[Addition]:
        """Return the manifest's entries of one kind, oldest first, such as all ``play`` commands on the run."""
        return [entry for entry in self.manifest.additions if entry.kind == kind]

    def file(self, name: str) -> Path | None:
        """Return the path of a file in the run directory; None if the file is missing or links out of the directory."""
        path = self.path / name
        return path if path.resolve().is_relative_to(self.path.resolve()) and path.is_file() else None

    def tried(self, read: Callable[[], T], instead: T) -> T:
        """Return the result of ``read()``; if it fails, add the error to ``problems`` and return ``instead``."""
        try:
            return read()
        except WheellegError as error:
            self.problems.append(str(error))
        except (OSError, ValueError, TypeError, AttributeError, KeyError) as error:
            self.problems.append(f"{type(error).__name__}: {error}")
        return instead


def open_subject(name: str | Path, root: Path) -> Subject:
    """Open a training run by its path, its id, or as ``latest``; open a zero or random agent's run by its path."""
    folder = Path(name)
    if (folder / _FIGURES).is_file() and (folder / _SETTINGS).is_file() and not (folder / MANIFEST_NAME).exists():
        subject = Subject(folder.resolve(), None)
        subject.agent_figures = subject.tried(lambda: dict(read_json(folder / _FIGURES)), {})
        subject.config = subject.tried(lambda: _mapping(subject, _SETTINGS), {})
        return subject
    return _training(RunDirectory.open(name, root, odd=True))


def _training(run: RunDirectory) -> Subject:
    manifest = run.manifest()
    subject = Subject(run.path, run, manifest.facts, effective_status(manifest))
    overrides = subject.file(OVERRIDES)
    typed = subject.tried(lambda: read_yaml(overrides) if overrides else None, None)
    subject.overrides = [str(text) for text in typed] if isinstance(typed, list) else None
    nothing: Mapping[str, object] = {}
    subject.config = {part: subject.tried(partial(_mapping, subject, f"params/{part}.yaml"), nothing) for part in PARTS}
    hydra = subject.tried(lambda: _mapping(subject, ".hydra/hydra.yaml"), nothing)
    runtime = section_at(hydra, "hydra.runtime")
    subject.choices, sources = section_at(runtime, "choices"), runtime.get("config_sources")
    if hydra and not (isinstance(runtime.get("choices"), Mapping) and isinstance(sources, list)):
        subject.problems.append("the file .hydra/hydra.yaml lacks the choices or the config folders of the run")
    found = [entry for entry in (sources if isinstance(sources, list) else ()) if isinstance(entry, Mapping)]
    kept = [entry for entry in found if entry.get("schema") == "file" and entry.get("provider") != "main"]
    # Read only those folders of the run's Hydra search path that the user trusts.
    subject.config_dirs = tuple(own_folders(str(entry["path"]) for entry in kept if entry.get("path")))
    subject.scalars = subject.tried(lambda: _scalars(subject), {})
    return subject


def _mapping(subject: Subject, name: str) -> Mapping[str, object]:
    path = subject.file(name)
    if path is None:
        raise RunDirectoryError(f"the run has no file {name}")
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise RunDirectoryError(f"the file {name} does not contain a mapping")
    return content


def _scalars(subject: Subject) -> dict[str, Series]:
    path = subject.file("iterations.jsonl")
    if path is None:
        return {}
    rows: dict[int, Mapping[str, object]] = {}
    broken = 0
    for line in read_lines(path):
        entry = read_line(line)
        if entry is None:
            broken += 1
        else:
            rows[entry["iteration"]] = entry["scalars"]
    if broken:
        subject.problems.append(f"{broken} of the lines of iterations.jsonl cannot be read and are left out")
    found: dict[str, list[tuple[int, float]]] = {}
    for iteration in sorted(rows):
        for name, value in rows[iteration].items():
            if is_number(value):
                found.setdefault(name, []).append((iteration, float(value)))
    return {name: Series(*zip(*points, strict=True)) for name, points in found.items()}


def is_number(value: object) -> TypeGuard[float]:
    """Return whether ``value`` is a number and not a boolean."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
