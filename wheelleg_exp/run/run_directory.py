"""Run directories: create one exclusively, find one by path, id or ``latest``, and name the paths inside it."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from wheelleg_exp.config.schema import NAME, NAME_WORDS
from wheelleg_exp.errors import ConfigError, RunDirectoryError, nearest_name
from wheelleg_exp.files import for_people, read_json
from wheelleg_exp.run.file_inventory import MANIFEST_NAME, is_inside, odd_entries
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.stock_policies import FOLDER, PREFIX, stock_names, stock_run
from wheelleg_exp.run.timestamps import folder_moment, folder_text

PIPELINE_NAME = "pipeline.json"


def is_pipeline(folder: Path) -> bool:
    """Return whether a folder belongs to a pipeline: it contains ``pipeline.json``, but not the manifest of a run."""
    return (folder / PIPELINE_NAME).is_file() and not (folder / MANIFEST_NAME).exists()


def pipeline_error(folder: Path) -> RunDirectoryError | None:
    """Return an error that lists the runs of a pipeline if ``folder`` belongs to a pipeline; otherwise, return None."""
    path = folder if folder.name == PIPELINE_NAME else folder / PIPELINE_NAME
    if not is_pipeline(path.parent):
        return None
    content, here, runs = read_json(path), Path.cwd(), list[str]()
    with suppress(LookupError, TypeError, AttributeError):  # A damaged index lists no runs.
        for name, named in [(phase["name"], phase.get("run")) for phase in content["phases"]]:
            if named:
                run = (path.parent / named).resolve()
                run = run.relative_to(here) if run.is_relative_to(here) else run
                runs.append(f"{run} (phase '{name}')")
    expected = " or ".join(runs) if runs else "a run of the pipeline, after its first phase has started"
    return RunDirectoryError(f"'{path.parent.name}' is a pipeline, and each of its phases is a run", expected=expected)


LATEST, AGENTS, SWEEPS = "latest", "agents", "sweeps"
REPLAYS, PIPELINES = "replays", "pipelines"
_NOT_TASKS = (AGENTS, SWEEPS, REPLAYS, PIPELINES, LATEST, FOLDER)

FAILURE = "failure.npz"  # The file with the simulation state that made a training fail.
CHECKPOINT = re.compile(r"model_(\d+)\.pt")
# The files from which the environment and agent of a run can be rebuilt.
NEEDED = ("params/env.yaml", "params/agent.yaml", ".hydra/config.yaml", "asset/robot.xml", "asset/asset.json")


class _PathInside:
    """An attribute of ``RunDirectory``: the path of a file or folder in the directory."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, run: RunDirectory, kind: type[RunDirectory]) -> Path:
        return run.path / self.name


@dataclass(frozen=True)
class RunDirectory(os.PathLike[str]):
    """One run directory. ``path`` is absolute."""

    path: Path

    def __fspath__(self) -> str:
        return str(self.path)

    @classmethod
    def create(
        cls,
        root: str | Path,
        task: str,
        seed: int,
        name: str | None = None,
        now: datetime | None = None,
        *,
        section: str | None = None,
    ) -> RunDirectory:
        """Create the run directory ``<root>/<task>/<YYYY-mm-dd_HH-MM-SS>_<seed>[_<name>]``; the time is local.

        If the run directory already exists, the suffix ``-2``, ``-3``, … makes its name unique. ``section`` is the
        subfolder ``agents`` or ``replays`` of ``root``; ``wheelleg list runs`` does not show its runs.
        """
        for part, key in ((task, "task.name"), ("run" if name is None else name, "run.name")):
            if not isinstance(part, str) or not re.fullmatch(NAME, part):
                raise ConfigError(f"{part!r} cannot be part of a folder name", key=key, expected=NAME_WORDS)
        if task in _NOT_TASKS:
            message = f"'{task}' is reserved and cannot be the name of a task"
            raise ConfigError(message, key="task.name", expected="another name")
        parts = [folder_text(now or datetime.now()), str(int(seed)), *([] if name is None else [name])]
        base = Path(root) / section if section else Path(root)
        return cls(create_exclusively(base / task, "_".join(parts)))

    @classmethod
    def open(cls, run: str | Path, root: str | Path, *, odd: bool = False) -> RunDirectory:
        """Find a run directory by path, by run id (``<folder>`` or ``<task>/<folder>``), or by the name ``latest``.

        ``stock:NAME`` is the run directory of a policy that ships with ``wheelleg_exp``. Links, pipes, and devices
        raise RunDirectoryError unless ``odd`` is true; the caller must then report them, and must not open them.
        """
        directory = cls(_found(run, Path(root)).resolve())
        directory.manifest()
        if not odd:
            for name, what in odd_entries(directory.path).items():
                message, key = f"the entry is {what}, which a run directory must not contain", directory.path / name
                raise RunDirectoryError(message, key=str(key), expected="only files and folders")
        return directory

    @property
    def id(self) -> str:
        return self.path.name

    @property
    def root(self) -> Path:
        above = self.path.parent.parent
        return above.parent if above.name in (AGENTS, REPLAYS) else above

    params = _PathInside("params")  # The folder with the parameter files ``env.yaml`` and ``agent.yaml``.
    hydra = _PathInside(".hydra")  # The folder with the files that Hydra writes.
    source = _PathInside("source")  # The folder with the recorded state of the source code.
    asset = _PathInside("asset")  # The folder with the robot's model files.
    exported = _PathInside("exported")  # The folder with the exported policies of a run.
    play = _PathInside("play")  # The folder with the recordings that ``wheelleg play`` made.
    videos = _PathInside("videos")  # The folder with the videos of the training.
    dataset = _PathInside("dataset")  # The folder with the episodes that recorder terms saved during the training.
    evaluation = _PathInside("evaluation")  # The folder with the results of a run's evaluations.
    recording = _PathInside("recording.rrd")  # The file with the recording of the training.
    iterations = _PathInside("iterations.jsonl")  # The file with one line of JSON for each training iteration.
    environment = _PathInside("environment.txt")  # The file that lists the installed Python packages.

    def manifest(self) -> Manifest:
        return Manifest.load(self.path)

    def inside(self, name: str) -> Path:
        """Return the path of a file in the run directory; raise RunDirectoryError for a path outside this directory."""
        if not is_inside(name) or not (self.path / name).resolve().is_relative_to(self.path.resolve()):
            raise RunDirectoryError(f"the path '{name}' is outside the run directory", expected="a path below it")
        return self.path / name

    def checkpoints(self) -> list[Path]:
        with for_people(self.path, "read"):
            found = [p for p in self.path.iterdir() if CHECKPOINT.fullmatch(p.name) and p.is_file()]
        return sorted(found, key=checkpoint_iteration)

    def latest_checkpoint(self) -> Path:
        found = self.checkpoints()
        if not found:
            raise RunDirectoryError(f"the run '{self.id}' has no checkpoint", expected="a file model_<iteration>.pt")
        return found[-1]

    def checkpoint(self, iteration: int) -> Path:
        """Return the path of one iteration's checkpoint; the error for a missing checkpoint names the nearest one."""
        found = {checkpoint_iteration(path): path for path in self.checkpoints()}
        if iteration in found:
            return found[iteration]
        nearest = min(found, key=lambda i: abs(i - iteration), default=None)
        message = f"run '{self.id}' has no checkpoint of iteration {iteration}"
        expected = "one of " + ", ".join(map(str, found)) if found else "a run that saved checkpoints"
        raise RunDirectoryError(message, expected=expected, nearest=None if nearest is None else found[nearest].name)


def checkpoint_iteration(path: Path) -> int:
    """Return the iteration in a checkpoint's file name; raise RunDirectoryError for a name without an iteration."""
    match = CHECKPOINT.fullmatch(path.name)
    if match is None:
        raise RunDirectoryError(f"'{path.name}' is not a checkpoint's file name", expected="model_<iteration>.pt")
    return int(match.group(1))


def create_exclusively(parent: Path, name: str) -> Path:
    """Create and return the folder ``parent/name``, or ``name-2``, ``name-3``, … if the name is taken."""
    with for_people(parent / name):
        parent.mkdir(parents=True, exist_ok=True)
        path, number = parent / name, 2
        while True:
            try:
                path.mkdir()
                return path.resolve()
            except FileExistsError:
                path, number = parent / f"{name}-{number}", number + 1


def run_folders(root: Path) -> list[Path]:
    """Return the run directories below ``root`` that have a manifest, sorted by path."""
    return sorted(path.parent for task in task_folders(root) for path in task.glob(f"*/{MANIFEST_NAME}"))


def start_moment(folder: Path) -> datetime:
    """Return the start of a run: from its manifest, else from its folder's name, else the earliest possible time."""
    try:
        return Manifest.load(folder).started
    except RunDirectoryError:
        return folder_moment(folder.name) or datetime.min.replace(tzinfo=UTC)


def task_folders(root: Path) -> list[Path]:
    """Return the task folders in ``root``; each task folder contains the runs of one task."""
    with for_people(root, "read"):
        folders = root.iterdir() if root.is_dir() else ()
        return [p for p in folders if p.is_dir() and p.name not in _NOT_TASKS and p.name[0] != "."]


def _found(run: str | Path, root: Path) -> Path:
    if str(run).startswith(PREFIX):
        return stock_run(str(run).removeprefix(PREFIX), root)
    if str(run) == LATEST:
        folders = run_folders(root)
        if not folders:
            raise RunDirectoryError(f"there is no run below '{root}'", expected="a training that was started")
        return max(folders, key=lambda folder: (start_moment(folder), folder.name))
    for candidate in (Path(run), root / run, root / FOLDER / run):
        if (candidate / MANIFEST_NAME).is_file():
            return candidate
    folders = run_folders(root)
    found = [folder for folder in folders if folder.name == str(run)]
    if len(found) > 1:
        tasks = " and ".join(f"{folder.parent.name}/{folder.name}" for folder in found)
        raise RunDirectoryError(f"'{run}' names {len(found)} runs", expected=f"one of {tasks}")
    if found:
        return found[0]
    shipped = [PREFIX + name for name in stock_names()]
    expected = ", ".join(["a path", f"an id below '{root}'", f"'{LATEST}'", *shipped])
    for place in (Path(run), root / run, root / PIPELINES / run):
        if pipeline := pipeline_error(place):
            raise pipeline
        if place.exists():
            holder = next((str(p) for p in place.resolve().parents if (p / MANIFEST_NAME).is_file()), None)
            message = f"'{place}' is not a run directory: it has no {MANIFEST_NAME}"
            raise RunDirectoryError(message, expected=expected, nearest=holder)
    names = [LATEST, *shipped, *(name for f in folders for name in (f.name, f"{f.parent.name}/{f.name}"))]
    raise RunDirectoryError(f"there is no run '{run}'", expected=expected, nearest=nearest_name(str(run), names))
