"""List, filter, and sort runs and sweeps below a folder, fast: hash no file, read only the ends of logs."""

from __future__ import annotations

import fnmatch
import operator
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.files import open_file, read_text
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import LogLine, read_line, read_log, seconds_of
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.records import Failure
from wheelleg_exp.run.run_config import written_config
from wheelleg_exp.run.run_directory import CHECKPOINT, NEEDED, SWEEPS, run_folders, start_moment, task_folders
from wheelleg_exp.run.run_index import SWEEP_NAME, SweepIndex
from wheelleg_exp.run.run_lock import is_alive
from wheelleg_exp.run.timestamps import folder_moment, parse_utc, utc_now

CRASHED, DAMAGED = "crashed", "damaged"
_DAMAGES = (RunDirectoryError, LookupError, TypeError, ValueError, AttributeError)  # errors of a damaged sweep.json

_FOLDER = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_-?\d+(?:_(?P<name>.+))?")
_TOTAL = re.compile(r"^max_iterations:\s*(\d{1,18})\b", re.MULTILINE)
_TAIL_BYTES = 65536  # Read only the last 64 KiB of iterations.jsonl, because each line of the file is shorter.
# ``FIGURES`` maps short names of performance metrics to the names of scalars in the training log.
FIGURES = {
    "return": "Train/mean_reward",
    "episode_length": "Train/mean_episode_length",
    "time_out": "Episode_Termination/time_out",
}


@dataclass(frozen=True)
class RunSummary:
    """The facts about one run that the command ``wheelleg list runs`` shows."""

    id: str
    task: str
    status: str  # ``status`` is ``crashed`` for a killed run and ``damaged`` for an unreadable manifest.
    path: Path
    started: datetime
    ended: str | None = None
    seeds: tuple[int, ...] = ()
    results: Mapping[str, object] = field(default_factory=dict)
    problem: str | None = None  # ``problem`` says why a run failed or is damaged, or counts episodes with NaN or inf.
    failure: Failure | None = None  # The error message, config key, and training iteration of a failed run.
    name: str | None = None
    iterations: int | None = None  # The number of finished iterations.
    max_iterations: int | None = None
    checkpoint: int | None = None  # The iteration of the run's last checkpoint.
    resumable: bool = False  # True if ``wheelleg resume`` can continue the run.
    resumes: int = 0
    # ``figures`` maps the name of each metric in ``FIGURES`` to the metric's last logged value.
    figures: dict[str, float] = field(default_factory=dict)
    played: Mapping[str, object] = field(default_factory=dict)  # The results of the run's last ``wheelleg play``.
    evaluated: Mapping[str, object] = field(default_factory=dict)  # The results of the run's last evaluation.
    bundles: tuple[str, ...] = ()  # The folders of the run's exported deployment bundles.
    seconds: float | None = None  # The training time up to the last iteration, without pauses before a resume, s.
    bytes: int | None = None  # The size of all files directly in the run directory, without subfolders, in bytes.


def list_runs(root: str | Path) -> list[RunSummary]:
    """Return a summary of every run below ``root``, the newest first; return no runs if ``root`` does not exist."""
    folders = run_folders(Path(root))
    # A run that was killed at its start has a run directory without a manifest.
    for folder in (folder for task in task_folders(Path(root)) for folder in task.iterdir()):
        if _FOLDER.fullmatch(folder.name) and folder.is_dir() and not (folder / MANIFEST_NAME).exists():
            folders.append(folder)
    return sorted(map(summarize, folders), key=lambda s: (s.started, s.id), reverse=True)


def summarize(folder: Path) -> RunSummary:
    """Return the summary of one run directory; a damaged run gets the status ``damaged``."""
    try:
        manifest = Manifest.load(folder)
    except RunDirectoryError as error:
        return RunSummary(folder.name, folder.parent.name, DAMAGED, folder, start_moment(folder), problem=str(error))
    facts, status = manifest.facts, effective_status(manifest)
    checkpoint, size = None, 0
    with os.scandir(folder) as entries:
        for file in entries:
            if match := CHECKPOINT.fullmatch(file.name):
                checkpoint = max(checkpoint or 0, int(match[1]))
            if file.is_file(follow_symlinks=False):
                size += file.stat(follow_symlinks=False).st_size
    last = _last_line(folder / "iterations.jsonl")
    recorded, scalars = facts.results.get("iterations"), facts.results
    done = recorded if isinstance(recorded, int) else None
    if last is not None:
        done, scalars = last["iteration"] + 1, last["scalars"]
    written, match = None, _FOLDER.fullmatch(folder.name)
    with suppress(RunDirectoryError):
        written = _TOTAL.search(read_text(folder / "params" / "agent.yaml"))
    total = int(written[1]) if written else None
    newest = {entry.kind: entry.results for entry in facts.additions}  # by command, such as ``play``
    exports = [entry.results for entry in facts.additions if entry.kind == "export"]
    return RunSummary(
        id=folder.name,
        task=facts.task,
        status=status,
        path=folder,
        started=manifest.started,
        ended=facts.ended,
        seeds=facts.seeds,
        results=facts.results,
        problem=(facts.error and facts.error.message) or non_finite_note(facts.results),
        failure=facts.failure,
        name=match["name"] if match else None,
        iterations=done,
        max_iterations=total,
        checkpoint=checkpoint,
        resumable=_resumable(folder, status, checkpoint, done, total),
        resumes=len(facts.resumes),
        figures={name: v for name, key in FIGURES.items() if isinstance(v := scalars.get(key), (int, float))},
        played=newest.get("play", {}),
        evaluated=newest.get("evaluation", {}),
        bundles=tuple(str(results["folder"]) for results in exports if "folder" in results),
        seconds=_seconds(folder, manifest, status),
        bytes=size,
    )


def non_finite_note(results: Mapping[str, object]) -> str | None:
    """Return a line with the number of episodes that NaN or inf ended; None if NaN and inf ended no episode."""
    counts = results.get("non_finite")
    listed = ", ".join(f"{key} {count}" for key, count in counts.items()) if isinstance(counts, Mapping) else ""
    return f"episodes that ended because a number was not finite: {listed}" if listed else None


def effective_status(manifest: Manifest) -> str:
    """Return the status in the manifest, or ``crashed`` if the status is ``running`` but the process has ended."""
    if manifest.status == "running" and is_alive(manifest.facts.process) is False:
        return CRASHED
    return manifest.status


@dataclass(frozen=True)
class SweepSummary:
    """The facts about a sweep that ``wheelleg list sweeps`` shows; ``jobs`` maps a job status to the number of jobs."""

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
    found = []
    for folder in (path.parent for path in (Path(root) / SWEEPS).glob(f"*/{SWEEP_NAME}")):
        moment = folder_moment(folder.name) or datetime.min.replace(tzinfo=UTC)
        try:
            data = SweepIndex.load(folder).data
            crashed = data["status"] == "running" and is_alive(data.get("process")) is False
            jobs = dict(Counter(job["status"] for job in data["jobs"]))
            swept = tuple(dict.fromkeys(word.split("=")[0] for job in data["jobs"] for word in job["swept"]))
            facts = (parse_utc(data["started"]), data["ended"], jobs, swept)
            found.append(SweepSummary(folder.name, CRASHED if crashed else data["status"], folder, *facts))
        except _DAMAGES as error:
            found.append(SweepSummary(folder.name, DAMAGED, folder, moment, problem=str(error)))
    return sorted(found, key=lambda s: (s.started, s.id), reverse=True)


def _resumable(folder: Path, status: str, checkpoint: int | None, done: int | None, total: int | None) -> bool:
    """Return whether ``wheelleg resume`` can continue a run, without opening the files of the run."""
    if status == "running" or total is None:
        return False
    if checkpoint is None:  # A run without a checkpoint can be resumed if its config and robot files exist.
        return total > 0 and all((folder / name).is_file() for name in NEEDED)
    computed = checkpoint + 1
    if (done or 0) < computed:  # Without log lines up to the checkpoint, a run cannot be resumed.
        return False
    # A run that stopped between its last iteration and the export can be resumed to export the policy.
    return computed < total or (computed == total and status != "finished")


def _last_line(path: Path) -> LogLine | None:
    """Return the last complete line of ``iterations.jsonl`` without reading the whole file."""
    try:
        with open_file(path) as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
            lines = file.read().split(b"\n")[:-1]  # The last log line is incomplete if it has no newline.
    except RunDirectoryError:
        return None
    return next((found for line in reversed(lines) if (found := read_line(line)) is not None), None)


def _seconds(folder: Path, manifest: Manifest, status: str) -> float | None:
    if manifest.facts.resumes:  # The manifest does not record the time at which a killed process ended.
        try:
            return seconds_of(line.content for line in read_log(folder / "iterations.jsonl").lines)
        except RunDirectoryError:
            return None
    if manifest.facts.ended is not None:
        moment = parse_utc(manifest.facts.ended)
    elif status == "running":
        moment = utc_now()
    else:
        try:
            moment = datetime.fromtimestamp((folder / "iterations.jsonl").stat().st_mtime, UTC)
        except OSError:
            return None
    return max(0.0, (moment - manifest.started).total_seconds())


_CONDITION = re.compile(r"(?P<key>[^=!<>]+)(?P<sign>!=|<=|>=|=|<|>)(?P<value>.*)")
_ORDERED = {"<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge}

# The options --filter and --sort accept the columns in _COLUMNS and the keys of a run's config.
_COLUMNS: dict[str, Callable[[RunSummary], object]] = {
    **{name: operator.attrgetter(name) for name in ("id", "task", "status", "name")},
    "seed": lambda run: run.seeds[0] if run.seeds else None,
    "started": lambda run: run.started.isoformat(),
    "done": lambda run: run.iterations,
    "took": lambda run: run.seconds,
    "size": lambda run: run.bytes,
    "played": lambda run: run.played.get("survival"),
    "resume": lambda run: run.resumable,
    "return": lambda run: run.figures.get("return"),
    "episode-length": lambda run: run.figures.get("episode_length"),
    "time-out": lambda run: run.figures.get("time_out"),
}


@dataclass(frozen=True)
class SweptRun:
    """A run of a sweep: the sweep's id, and the run's swept values by key."""

    sweep: str
    values: Mapping[str, str]


def swept_runs(root: Path) -> dict[Path, SweptRun]:
    """Return the sweep and the swept config values of each sweep run below ``root``; ignore damaged sweeps."""
    found: dict[Path, SweptRun] = {}
    for path in sorted((root / SWEEPS).glob(f"*/{SWEEP_NAME}")):
        with suppress(*_DAMAGES):
            found |= runs_of(SweepIndex.load(path.parent))
    return found


def runs_of(index: SweepIndex) -> dict[Path, SweptRun]:
    """Return the sweep's id and the swept config values of each run of a sweep, by run directory."""
    found = {}
    for job in index.jobs:
        folder = index.run_of(job)
        if folder is not None:
            words = (str(word).lstrip("+~").partition("=") for word in job["swept"])
            found[folder.resolve()] = SweptRun(index.folder.name, {key: value for key, _, value in words})
    return found


def find_sweep(name: str, root: Path) -> SweepIndex | None:
    """Find a sweep by its path, by its id, or by the name ``latest``; return None if the sweep does not exist."""
    known = sorted(path.parent for path in (root / SWEEPS).glob(f"*/{SWEEP_NAME}"))
    if name == "latest" and known:
        return SweepIndex.load(known[-1])
    folder = next((path for path in (Path(name), root / SWEEPS / name) if (path / SWEEP_NAME).is_file()), None)
    return None if folder is None else SweepIndex.load(folder)


def open_sweep(name: str, root: Path) -> SweepIndex:
    """Find a sweep like ``find_sweep``; raise WheellegError if the sweep does not exist."""
    index = find_sweep(name, root)
    if index is None:
        known = [sweep.id for sweep in list_sweeps(root)]
        expected = "'latest', or one of " + (", ".join(known[:5]) or "(there is none yet)")
        nearest = nearest_name(name, known)
        raise WheellegError(f"there is no sweep '{name}'", key="--sweep", expected=expected, nearest=nearest)
    return index


def filter_runs(runs: Sequence[RunSummary], conditions: Sequence[str]) -> list[RunSummary]:
    """Return the runs that meet every condition of ``--filter``.

    A condition is ``KEY=VALUE``, or has ``!=``, ``<``, ``<=``, ``>``, or ``>=`` instead of ``=``; ``*`` in VALUE
    matches any text. In a condition, ``KEY`` is a column of the list of runs or a key of the run's config.
    """
    kept = list(runs)
    for text in conditions:
        match = _CONDITION.fullmatch(text)
        if match is None:
            expected = "KEY=VALUE, or !=, <, <=, >, >="
            raise WheellegError(f"'{text}' is not a valid condition on runs", key="--filter", expected=expected)
        key, sign, wanted = match["key"].strip(), match["sign"], match["value"].strip()
        values = _values(runs, key, "--filter")
        known = [value for value in values.values() if value is not None]
        is_text = all(isinstance(value, str) and not value[:1].isdigit() for value in known)
        if known and is_text and sign in _ORDERED and _number(wanted) is not None:
            message = f"'{key}' is text, such as '{known[0]}', and {wanted} is a number"
            raise WheellegError(message, key="--filter", expected=f"{key}=TEXT")
        kept = [run for run in kept if _holds(values[run.path], sign, wanted)]
    return kept


def sort_runs(runs: Sequence[RunSummary], key: str, *, reverse: bool = False) -> list[RunSummary]:
    """Return runs by a column or config key, largest or latest first (``reverse``: last); runs without the key last."""
    values = _values(runs, key, "--sort")

    def rank(run: RunSummary) -> tuple[bool, float | str]:  # Sort numbers before texts.
        value = values[run.path]
        return (False, float(value)) if isinstance(value, (int, float)) else (True, str(value))

    known = sorted((run for run in runs if values[run.path] is not None), key=rank, reverse=not reverse)
    return [*known, *(run for run in runs if values[run.path] is None)]


def _values(runs: Iterable[RunSummary], key: str, where: str) -> dict[Path, object]:
    """Return the value of a column or config key for each run; None for a run that lacks the column or key."""
    column = _COLUMNS.get(key.replace("_", "-"))
    if column is not None:
        return {run.path: column(run) for run in runs}
    found: dict[Path, object] = {}
    for run in runs:
        value: object = written_config(run.path)
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        found[run.path] = value
    if found and all(value is None for value in found.values()):
        names = ", ".join(_COLUMNS)
        expected = f"one of {names}, or a key of their config such as agent.algorithm.gamma"
        raise WheellegError(f"no run has '{key}'", key=where, expected=expected, nearest=nearest_name(key, _COLUMNS))
    return found


def _holds(value: object, sign: str, wanted: str) -> bool:
    number = _number(wanted)
    if sign in _ORDERED:
        if isinstance(value, str):
            # A text that starts with a digit, such as a date, can be compared with a number.
            return (number is None or value[:1].isdigit()) and _ORDERED[sign](value, wanted)
        if number is None:
            raise WheellegError(f"the value '{wanted}' is not a number", key="--filter", expected=f"KEY{sign}NUMBER")
        return isinstance(value, (int, float)) and _ORDERED[sign](value, number)
    if isinstance(value, bool) or value is None:
        equal = wanted.lower() in {True: ("true", "yes"), False: ("false", "no"), None: ("null", "none", "-")}[value]
    elif isinstance(value, (int, float)) and number is not None:
        equal = float(value) == number
    else:
        equal = fnmatch.fnmatchcase(str(value), wanted)
    return equal == (sign == "=")


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
