"""The run or agent's run of a report: its files, read as far as they can be read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from wheelleg_exp.config.config_tree import at
from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.files import read_json, read_lines, read_yaml
from wheelleg_exp.packages import own_folders
from wheelleg_exp.plain_data import json_value
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.run_config import OVERRIDES, PARTS
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_list import effective_status

AGENT = "agent"
KIND = "report"  # kind of the manifest's entries for reports
_FIGURES, _SETTINGS = "figures.json", "config.yaml"

T = TypeVar("T")


@dataclass(frozen=True)
class Series:
    """One scalar over the iterations; ``at`` and ``values`` have the same length."""

    at: tuple[int, ...]
    values: tuple[float, ...]


@dataclass
class Subject:
    """One run, or one agent's run.

    Attributes:
        path: its folder.
        run: the run directory; None for an agent's run, which has no manifest.
        manifest: the manifest's content; empty without one.
        status: the manifest's status, ``crashed``, or ``agent``.
        config: the saved ``env`` and ``agent``, resolved and plain.
        overrides: the typed overrides; None if unknown.
        choices: the saved choices of Hydra (``task``, ``robot``, …).
        config_dirs: the user's config folders of the run.
        scalars: the training's scalars by name.
        agent_figures: the figures of an agent's run.
        problems: what could not be read, and why.
    """

    path: Path
    run: RunDirectory | None
    manifest: dict[str, Any] = field(default_factory=dict)
    status: str = AGENT
    config: dict[str, Any] = field(default_factory=dict)
    overrides: list[str] | None = None
    choices: dict[str, Any] = field(default_factory=dict)
    config_dirs: tuple[Path, ...] = ()
    scalars: dict[str, Series] = field(default_factory=dict)
    agent_figures: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def id(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def task(self) -> str:
        """The task's name."""
        return str(self.manifest.get("task") or self.path.parent.name)

    @property
    def step_s(self) -> float | None:
        """Duration of a control step, s; None if the config lacks it."""
        dt, decimation = self.setting("env.sim.dt"), self.setting("env.decimation")
        return dt * decimation if is_number(dt) and is_number(decimation) else None

    def setting(self, path: str) -> Any:
        """Return the value at a key of the config, or None."""
        return at(self.config, path)

    def last(self, name: str) -> float | None:
        """Return the last value of a scalar, or None."""
        series = self.scalars.get(name)
        return series.values[-1] if series and series.values else None

    def additions(self, kind: str) -> list[dict[str, Any]]:
        """Return the entries of later commands of a kind, oldest first."""
        return [entry for entry in self.manifest.get("additions", []) if entry.get("kind") == kind]

    def file(self, name: str) -> Path | None:
        """Return a file in the folder by its relative name; None if it is missing or a link leads elsewhere."""
        path = self.path / name
        inside = path.resolve().is_relative_to(self.path.resolve())
        return path if inside and path.is_file() else None

    def tried(self, read: Callable[[], T], instead: T) -> T:
        """Return the result of ``read``; if it fails, store the reason and return ``instead``."""
        try:
            return read()
        except WheellegError as error:
            self.problems.append(str(error))
        except (OSError, ValueError, TypeError, AttributeError, KeyError) as error:
            self.problems.append(f"{type(error).__name__}: {error}")
        return instead


def open_subject(name: str | Path, root: Path) -> Subject:
    """Return the run by path, id, or ``latest``, or the agent's run by path.

    Raises:
        RunDirectoryError: it is neither, or the manifest is damaged.
    """
    folder = Path(name)
    if (folder / _FIGURES).is_file() and (folder / _SETTINGS).is_file() and not (folder / MANIFEST_NAME).exists():
        return _agent(folder.resolve())
    return _training(RunDirectory.open(name, root, odd=True))


def _training(run: RunDirectory) -> Subject:
    manifest = run.manifest()
    subject = Subject(run.path, run, manifest.data, effective_status(manifest))
    subject.overrides = subject.tried(partial(_overrides, subject), None)
    nothing: dict[str, Any] = {}
    subject.config = {part: subject.tried(partial(_mapping, subject, f"params/{part}.yaml"), nothing) for part in PARTS}
    runtime = subject.tried(partial(_runtime, subject), nothing)
    subject.choices = subject.tried(lambda: dict(runtime.get("choices") or {}), nothing)
    subject.config_dirs = subject.tried(lambda: tuple(_own_folders(runtime.get("config_sources") or [])), ())
    subject.scalars = subject.tried(lambda: _scalars(subject), {})
    return subject


def _agent(folder: Path) -> Subject:
    subject = Subject(folder, None)
    subject.agent_figures = subject.tried(lambda: dict(read_json(folder / _FIGURES)), {})
    subject.config = subject.tried(lambda: _mapping(subject, _SETTINGS), {})
    return subject


def _mapping(subject: Subject, name: str) -> dict[str, Any]:
    path = subject.file(name)
    if path is None:
        raise RunDirectoryError(f"the run has no {name}")
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise RunDirectoryError(f"{name} is not a mapping")
    return content


def _runtime(subject: Subject) -> dict[str, Any]:
    return dict(_mapping(subject, ".hydra/hydra.yaml")["hydra"]["runtime"])


def _overrides(subject: Subject) -> list[str] | None:
    path = subject.file(OVERRIDES)
    content = read_yaml(path) if path else None
    return [str(text) for text in content] if isinstance(content, list) else None


def _own_folders(sources: Iterable[Mapping[str, Any]]) -> list[Path]:
    """Return the registered folders of Hydra's search path. Other recorded folders are not trusted."""
    kept = [entry for entry in sources if entry.get("schema") == "file" and entry.get("provider") != "main"]
    return own_folders(str(entry["path"]) for entry in kept if entry.get("path"))


def _scalars(subject: Subject) -> dict[str, Series]:
    path = subject.file("iterations.jsonl")
    if path is None:
        return {}
    rows: dict[int, Mapping[str, Any]] = {}
    broken = sum(not _take(line, rows) for line in read_lines(path))
    if broken:
        subject.problems.append(f"{broken} of the lines of iterations.jsonl cannot be read and are left out")
    return _by_name(rows)


def _take(line: bytes, rows: dict[int, Mapping[str, Any]]) -> bool:
    try:
        entry = json_value(line)
        rows[int(entry["iteration"])] = dict(entry["scalars"])
    except (ValueError, TypeError, KeyError, OverflowError):
        return False
    return True


def _by_name(rows: Mapping[int, Mapping[str, Any]]) -> dict[str, Series]:
    found: dict[str, list[tuple[int, float]]] = {}
    for iteration in sorted(rows):
        for name, value in rows[iteration].items():
            if is_number(value):
                found.setdefault(str(name), []).append((iteration, float(value)))
    return {name: Series(*zip(*points, strict=True)) for name, points in found.items()}


def is_number(value: Any) -> bool:
    """Return whether a value is a number and not a boolean."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
