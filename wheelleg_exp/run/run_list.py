"""List, filter, and sort the runs and sweeps below a folder.

No file is hashed. Of growing files, only the end is read.
"""

from __future__ import annotations

import fnmatch
import operator
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.files import open_file, read_text
from wheelleg_exp.plain_data import json_value
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import read_log, seconds_of
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_config import written_config
from wheelleg_exp.run.run_directory import CHECKPOINT, NEEDED, SWEEPS, run_folders, start_moment, task_folders
from wheelleg_exp.run.run_index import SWEEP_NAME, SweepIndex
from wheelleg_exp.run.run_lock import is_alive
from wheelleg_exp.run.timestamps import folder_moment, parse_utc, utc_now

CRASHED = "crashed"
DAMAGED = "damaged"

_FOLDER = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_-?\d+(?:_(?P<name>.+))?")
_TOTAL = re.compile(r"^max_iterations:\s*(\d{1,18})\b", re.MULTILINE)
_TAIL_BYTES = 65536  # more than one line of iterations.jsonl
# The figures of a training and their scalars.
FIGURES = {
    "return": "Train/mean_reward",
    "episode_length": "Train/mean_episode_length",
    "time_out": "Episode_Termination/time_out",
}


@dataclass(frozen=True)
class RunSummary:
    """One run of the list.

    Attributes:
        id: the folder's name.
        task: the task's name.
        status: the manifest's status (``running``, ``finished``, ``interrupted``, ``failed``), or ``crashed`` (recorded
            as running, but its process has ended), or ``damaged`` (the manifest cannot be read).
        path: the folder.
        started: the start.
        ended: the end as text; None when it is not recorded.
        seeds: the seeds.
        results: the manifest's results.
        problem: why the run failed or is damaged, or the number of episodes that ended because a value was not finite.
        failure: the recorded failure: message, config key, iteration; None when no failure is recorded.
        name: ``run.name``.
        iterations: number of finished iterations.
        max_iterations: number of iterations that the training should reach.
        checkpoint: iteration of the last checkpoint.
        resumable: whether ``resume`` can continue, from the last checkpoint or from the start.
        resumes: how often the run was resumed.
        figures: mean return and length of the last episodes, and the share of episodes that reached the time limit.
        played: results of the last play.
        evaluated: results of the last evaluation.
        bundles: folders that were exported for deployment.
        seconds: duration up to the last iteration, without the pauses before a resume.
        bytes: size of the files directly in the run directory.
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
    failure: dict[str, Any] | None = None
    name: str | None = None
    iterations: int | None = None
    max_iterations: int | None = None
    checkpoint: int | None = None
    resumable: bool = False
    resumes: int = 0
    figures: dict[str, float] = field(default_factory=dict)
    played: dict[str, Any] = field(default_factory=dict)
    evaluated: dict[str, Any] = field(default_factory=dict)
    bundles: tuple[str, ...] = ()
    seconds: float | None = None
    bytes: int | None = None


def list_runs(root: str | Path) -> list[RunSummary]:
    """Return a summary of every run below ``root``, the newest first; empty when ``root`` does not exist."""
    folders = [*run_folders(Path(root)), *_folders_without_manifest(Path(root))]
    return sorted(map(summarize, folders), key=lambda s: (s.started, s.id), reverse=True)


def summarize(folder: Path) -> RunSummary:
    """Return the summary of one run directory; a damaged run gets the status ``damaged``."""
    try:
        manifest = Manifest.load(folder)
    except RunDirectoryError as error:
        return RunSummary(folder.name, folder.parent.name, DAMAGED, folder, start_moment(folder), problem=str(error))
    data, status = manifest.data, effective_status(manifest)
    checkpoint, size = _checkpoint_and_size(folder)
    done, scalars = _progress(folder, data["results"])
    total = _total(folder)
    return RunSummary(
        id=folder.name,
        task=data["task"],
        status=status,
        path=folder,
        started=manifest.started,
        ended=data.get("ended"),
        seeds=tuple(data.get("seeds") or ()),
        results=manifest.results,
        problem=(data.get("error") or {}).get("message") or non_finite_note(manifest.results),
        failure=data.get("failure"),
        name=_name(folder.name),
        iterations=done,
        max_iterations=total,
        checkpoint=checkpoint,
        resumable=_resumable(folder, status, checkpoint, done, total),
        resumes=len(data["resumes"]),
        figures={name: scalars[key] for name, key in FIGURES.items() if isinstance(scalars.get(key), (int, float))},
        played=_last_results(data["additions"], "play"),
        evaluated=_last_results(data["additions"], "evaluation"),
        bundles=_bundles(data["additions"]),
        seconds=_seconds(folder, manifest, status),
        bytes=size,
    )


def non_finite_note(results: Mapping[str, Any]) -> str | None:
    """Return a line that counts the episodes that ended because a value was not finite; None without such episodes."""
    counts = results.get("non_finite") or {}
    listed = ", ".join(f"{key} {count}" for key, count in counts.items())
    return f"episodes that ended because a number was not finite: {listed}" if listed else None


def effective_status(manifest: Manifest) -> str:
    """Return the manifest's status, or ``crashed`` when it is ``running`` and its process has ended."""
    if manifest.status == "running" and is_alive(manifest.data.get("process") or {}) is False:
        return CRASHED
    return manifest.status


@dataclass(frozen=True)
class SweepSummary:
    """One sweep of the list; ``jobs`` counts the jobs by status."""

    id: str
    status: str
    path: Path
    started: datetime
    ended: str | None = None
    jobs: dict[str, int] = field(default_factory=dict)
    swept: tuple[str, ...] = ()
    problem: str | None = None


def list_sweeps(root: str | Path) -> list[SweepSummary]:
    """Return a summary of every sweep below ``root``, the newest first."""
    found = [_sweep(path.parent) for path in (Path(root) / SWEEPS).glob(f"*/{SWEEP_NAME}")]
    return sorted(found, key=lambda s: (s.started, s.id), reverse=True)


def _sweep(folder: Path) -> SweepSummary:
    moment = folder_moment(folder.name) or datetime.min.replace(tzinfo=UTC)
    try:
        data = SweepIndex.load(folder).data
        crashed = data["status"] == "running" and is_alive(data.get("process") or {}) is False
        jobs: dict[str, int] = {}
        for job in data["jobs"]:
            jobs[job["status"]] = jobs.get(job["status"], 0) + 1
        swept = tuple(dict.fromkeys(word.split("=")[0] for job in data["jobs"] for word in job["swept"]))
        status = CRASHED if crashed else data["status"]
        return SweepSummary(folder.name, status, folder, parse_utc(data["started"]), data["ended"], jobs, swept)
    except (RunDirectoryError, LookupError, TypeError, ValueError, AttributeError) as error:
        return SweepSummary(folder.name, DAMAGED, folder, moment, problem=str(error))


def _folders_without_manifest(root: Path) -> Iterator[Path]:
    """Yield the folders that are named like runs but have no manifest, because the run was killed at its start."""
    for task in task_folders(root):
        for folder in task.iterdir():
            if _FOLDER.fullmatch(folder.name) and folder.is_dir() and not (folder / MANIFEST_NAME).exists():
                yield folder


def _resumable(folder: Path, status: str, checkpoint: int | None, done: int | None, total: int | None) -> bool:
    """Return whether ``resume`` can continue a run, judged without reading the run's files."""
    if status == "running" or total is None:
        return False
    if checkpoint is None:  # the resume starts from the beginning, for which it needs these files
        return total > 0 and all((folder / name).is_file() for name in NEEDED)
    computed = checkpoint + 1
    if (done or 0) < computed:  # the log would have a gap
        return False
    return computed < total or (computed == total and status != "finished")  # only the export is left


def _name(folder: str) -> str | None:
    match = _FOLDER.fullmatch(folder)
    return match["name"] if match else None


def _checkpoint_and_size(folder: Path) -> tuple[int | None, int]:
    """Return the iteration of the last checkpoint, and the size of the files directly in the folder."""
    newest, size = None, 0
    with os.scandir(folder) as entries:
        for entry in entries:
            match = CHECKPOINT.fullmatch(entry.name)
            if match is not None:
                newest = max(newest or 0, int(match[1]))
            if entry.is_file(follow_symlinks=False):
                size += entry.stat(follow_symlinks=False).st_size
    return newest, size


def _progress(folder: Path, results: Mapping[str, Any]) -> tuple[int | None, Mapping[str, Any]]:
    """Return the number of finished iterations and the scalars of the last iteration."""
    last = _last_line(folder / "iterations.jsonl")
    if last is not None:
        return last["iteration"] + 1, last["scalars"]
    done = results.get("iterations")
    return (done if isinstance(done, int) else None), results


def _last_line(path: Path) -> dict[str, Any] | None:
    """Return the last whole line of ``iterations.jsonl``; only the end of the file is read."""
    try:
        with open_file(path) as file:
            end = file.seek(0, os.SEEK_END)
            file.seek(max(0, end - _TAIL_BYTES))
            lines = file.read().split(b"\n")[:-1]  # text without a newline was cut off
    except RunDirectoryError:
        return None
    for line in reversed(lines):
        try:
            value = json_value(line)
        except ValueError:
            continue
        if (
            isinstance(value, dict)
            and isinstance(value.get("iteration"), int)
            and isinstance(value.get("scalars"), dict)
        ):
            return value
    return None


def _total(folder: Path) -> int | None:
    try:
        match = _TOTAL.search(read_text(folder / "params" / "agent.yaml"))
    except RunDirectoryError:
        return None
    return int(match[1]) if match else None


def _last_results(additions: list[dict[str, Any]], kind: str) -> dict[str, Any]:
    entries = [entry for entry in additions if entry.get("kind") == kind]
    found = entries[-1].get("results") if entries else None
    return found if isinstance(found, dict) else {}


def _bundles(additions: list[dict[str, Any]]) -> tuple[str, ...]:
    exports = [entry.get("results") for entry in additions if entry.get("kind") == "export"]
    return tuple(str(found["folder"]) for found in exports if isinstance(found, dict) and "folder" in found)


def _seconds(folder: Path, manifest: Manifest, status: str) -> float | None:
    if manifest.data["resumes"]:  # the end of a killed process is not recorded
        try:
            return seconds_of(line.content for line in read_log(folder / "iterations.jsonl").lines)
        except RunDirectoryError:
            return None
    if manifest.data.get("ended") is not None:
        moment = parse_utc(manifest.data["ended"])
    elif status == "running":
        moment = utc_now()
    else:
        try:
            moment = datetime.fromtimestamp((folder / "iterations.jsonl").stat().st_mtime, UTC)
        except OSError:
            return None
    return max(0.0, (moment - manifest.started).total_seconds())


_CONDITION = re.compile(r"(?P<key>[^=!<>]+)(?P<sign>!=|<=|>=|=|<|>)(?P<value>.*)")
_ORDERED: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}


def _figure(name: str, run: RunSummary) -> float | None:
    return run.figures.get(name)


# The columns of the list. The keys of a run's config are accepted in addition.
_COLUMNS: dict[str, Callable[[RunSummary], Any]] = {
    "id": lambda run: run.id,
    "task": lambda run: run.task,
    "status": lambda run: run.status,
    "name": lambda run: run.name,
    "seed": lambda run: run.seeds[0] if run.seeds else None,
    "started": lambda run: run.started.isoformat(),
    "done": lambda run: run.iterations,
    "took": lambda run: run.seconds,
    "size": lambda run: run.bytes,
    "played": lambda run: run.played.get("survival"),
    "resume": lambda run: run.resumable,
    **{name.replace("_", "-"): partial(_figure, name) for name in FIGURES},
}


@dataclass(frozen=True)
class SweptRun:
    """A run of a sweep: the sweep's id, and the run's swept values by key."""

    sweep: str
    values: Mapping[str, str]


def swept_runs(root: Path) -> dict[Path, SweptRun]:
    """Return the runs of all sweeps below ``root`` by folder; a damaged index is ignored."""
    found: dict[Path, SweptRun] = {}
    for path in sorted((root / SWEEPS).glob(f"*/{SWEEP_NAME}")):
        try:
            found |= runs_of(SweepIndex.load(path.parent))
        except (RunDirectoryError, LookupError, TypeError, ValueError, AttributeError):
            continue
    return found


def runs_of(index: SweepIndex) -> dict[Path, SweptRun]:
    """Return the runs of a sweep by folder."""
    found = {}
    for job in index.jobs:
        folder = index.run_of(job)
        if folder is not None:
            words = (str(word).lstrip("+~").partition("=") for word in job["swept"])
            found[folder.resolve()] = SweptRun(index.folder.name, {key: value for key, _, value in words})
    return found


def find_sweep(name: str, root: Path) -> SweepIndex | None:
    """Return the sweep with a path, an id, or the name ``latest``; None when it does not exist.

    Raises:
        RunDirectoryError: the index of the sweep is broken.
    """
    known = sorted(path.parent for path in (root / SWEEPS).glob(f"*/{SWEEP_NAME}"))
    if name == "latest" and known:
        return SweepIndex.load(known[-1])
    folder = next((path for path in (Path(name), root / SWEEPS / name) if (path / SWEEP_NAME).is_file()), None)
    return None if folder is None else SweepIndex.load(folder)


def filter_runs(runs: Sequence[RunSummary], conditions: Sequence[str]) -> list[RunSummary]:
    """Return the runs that meet every condition.

    Args:
        runs: the runs.
        conditions: ``KEY=VALUE`` with ``*`` as a wildcard, or with ``!=``, ``<``, ``<=``, ``>``, ``>=``.
            A key is a column of the list or a key of the run's config.

    Raises:
        WheellegError: a condition has a wrong form or an unknown key, or compares a text with a number.
    """
    kept = list(runs)
    for text in conditions:
        match = _CONDITION.fullmatch(text)
        if match is None:
            raise WheellegError(
                f"'{text}' is not a condition", key="--filter", expected="KEY=VALUE, or !=, <, <=, >, >="
            )
        values = _values(runs, match["key"].strip(), "--filter")
        wanted = match["value"].strip()
        if match["sign"] in _ORDERED and _number(wanted) is not None:
            _require_ordered(match["key"].strip(), [value for value in values.values() if value is not None], wanted)
        kept = [run for run in kept if _holds(values[run.path], match["sign"], wanted)]
    return kept


def sort_runs(runs: Sequence[RunSummary], key: str, *, reverse: bool = False) -> list[RunSummary]:
    """Return the runs sorted by a key, the largest or latest first, and runs without the key last.

    Args:
        runs: the runs.
        key: a column of the list, or a key of the run's config.
        reverse: whether the smallest is first.

    Raises:
        WheellegError: no run has the key.
    """
    values = _values(runs, key, "--sort")
    known = [run for run in runs if values[run.path] is not None]
    known.sort(key=lambda run: _sortable(values[run.path]), reverse=not reverse)
    return [*known, *(run for run in runs if values[run.path] is None)]


def _values(runs: Iterable[RunSummary], key: str, where: str) -> dict[Path, Any]:
    """Return the value of each run at a key; None where a run does not have the key."""
    column = _COLUMNS.get(key.replace("_", "-"))
    if column is not None:
        return {run.path: column(run) for run in runs}
    found = {run.path: _config_value(written_config(run.path), key) for run in runs}
    if found and all(value is None for value in found.values()):
        names = ", ".join(_COLUMNS)
        expected = f"one of {names}, or a key of their config such as agent.algorithm.gamma"
        raise WheellegError(f"no run has '{key}'", key=where, expected=expected, nearest=nearest_name(key, _COLUMNS))
    return found


def _config_value(config: Any, key: str) -> Any:
    for part in key.split("."):
        config = config.get(part) if isinstance(config, Mapping) else None
    return config


def _require_ordered(key: str, known: Sequence[Any], wanted: str) -> None:
    """Raise when all values are texts, which cannot be compared with a number."""
    if known and all(isinstance(value, str) and not _starts_with_digit(value) for value in known):
        raise WheellegError(
            f"'{key}' is text, such as '{known[0]}', and {wanted} is a number", key="--filter", expected=f"{key}=TEXT"
        )


def _starts_with_digit(text: str) -> bool:
    """Return whether a text starts with a digit, as a date or an id does; a year is then a prefix of the text."""
    return text[:1].isdigit()


def _holds(value: Any, sign: str, wanted: str) -> bool:
    if sign in _ORDERED:
        number = _number(wanted)
        if isinstance(value, str):
            return (number is None or _starts_with_digit(value)) and _ORDERED[sign](value, wanted)
        if number is None:
            raise WheellegError(f"'{wanted}' is not a number", key="--filter", expected=f"KEY{sign}NUMBER")
        return isinstance(value, (int, float)) and _ORDERED[sign](value, number)
    return _same(value, wanted) == (sign == "=")


def _same(value: Any, wanted: str) -> bool:
    if isinstance(value, bool) or value is None:
        return wanted.lower() in ({True: ("true", "yes"), False: ("false", "no"), None: ("null", "none", "-")}[value])
    number = _number(wanted)
    if isinstance(value, (int, float)) and number is not None:
        return float(value) == number
    return fnmatch.fnmatchcase(str(value), wanted)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _sortable(value: Any) -> tuple[int, Any]:
    return (0, float(value)) if isinstance(value, (int, float)) else (1, str(value))
