"""Which of many runs, in which order, and in what those of a sweep differ."""

from __future__ import annotations

import fnmatch
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.run.directory import SWEEPS
from wheelleg_exp.run.listing import FIGURES, RunSummary
from wheelleg_exp.run.recorded import written_config
from wheelleg_exp.run.sweep_index import SWEEP_NAME, SweepIndex

_CONDITION = re.compile(r"(?P<key>[^=!<>]+)(?P<sign>!=|<=|>=|=|<|>)(?P<value>.*)")
_ORDERED: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}


def _figure(name: str, run: RunSummary) -> float | None:
    return run.figures.get(name)


# What is told of every run, beside the keys of its config.
_TOLD: dict[str, Callable[[RunSummary], Any]] = {
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
class Swept:
    """What a sweep says of one of its runs: the sweep's id, and the values in which its runs differ, by key."""

    sweep: str
    values: Mapping[str, str]


def swept_runs(root: Path) -> dict[Path, Swept]:
    """Return the runs of all sweeps below ``root``, by folder; a damaged index has none."""
    found: dict[Path, Swept] = {}
    for path in sorted((root / SWEEPS).glob(f"*/{SWEEP_NAME}")):
        try:
            found |= runs_of(SweepIndex.load(path.parent))
        except (RunDirectoryError, LookupError, TypeError, ValueError, AttributeError):
            continue
    return found


def runs_of(index: SweepIndex) -> dict[Path, Swept]:
    """Return the runs of a sweep, by folder."""
    found = {}
    for job in index.jobs:
        folder = index.run_of(job)
        if folder is not None:
            words = (str(word).lstrip("+~").partition("=") for word in job["swept"])
            found[folder.resolve()] = Swept(index.folder.name, {key: value for key, _, value in words})
    return found


def find_sweep(name: str, root: Path) -> SweepIndex | None:
    """Return the sweep that a path, an id or ``latest`` names; None where none is named so.

    Raises:
        RunDirectoryError: its index is broken.
    """
    known = sorted(path.parent for path in (root / SWEEPS).glob(f"*/{SWEEP_NAME}"))
    if name == "latest" and known:
        return SweepIndex.load(known[-1])
    folder = next((path for path in (Path(name), root / SWEEPS / name) if (path / SWEEP_NAME).is_file()), None)
    return None if folder is None else SweepIndex.load(folder)


def chosen(runs: Sequence[RunSummary], conditions: Sequence[str]) -> list[RunSummary]:
    """Return the runs for which every condition holds.

    Args:
        runs: all of them.
        conditions: ``KEY=VALUE``, in which ``*`` stands for anything, and ``!=``, ``<``, ``<=``, ``>``, ``>=``; a key
            is a column of the list or one of the run's config.

    Raises:
        WheellegError: one is no condition, or no run has its key, or it compares text with a number.
    """
    kept = list(runs)
    for text in conditions:
        match = _CONDITION.fullmatch(text)
        if match is None:
            raise WheellegError(f"'{text}' is no condition", key="--filter", expected="KEY=VALUE, or !=, <, <=, >, >=")
        values = _values(runs, match["key"].strip(), "--filter")
        wanted = match["value"].strip()
        if match["sign"] in _ORDERED and _number(wanted) is not None:
            _require_ordered(match["key"].strip(), [value for value in values.values() if value is not None], wanted)
        kept = [run for run in kept if _holds(values[run.path], match["sign"], wanted)]
    return kept


def ordered(runs: Sequence[RunSummary], key: str, *, reverse: bool = False) -> list[RunSummary]:
    """Return runs by a key, the largest or latest first; those without it at the end.

    Args:
        runs: all of them.
        key: a column of the list, or a key of the run's config.
        reverse: whether the smallest comes first.

    Raises:
        WheellegError: no run has the key.
    """
    values = _values(runs, key, "--sort")
    known = [run for run in runs if values[run.path] is not None]
    known.sort(key=lambda run: _sortable(values[run.path]), reverse=not reverse)
    return [*known, *(run for run in runs if values[run.path] is None)]


def _values(runs: Iterable[RunSummary], key: str, where: str) -> dict[Path, Any]:
    """Return what each run has at a key, None for what it has not."""
    told = _TOLD.get(key.replace("_", "-"))
    if told is not None:
        return {run.path: told(run) for run in runs}
    found = {run.path: _at(written_config(run.path), key) for run in runs}
    if found and all(value is None for value in found.values()):
        names = ", ".join(_TOLD)
        expected = f"one of {names}, or a key of their config such as agent.algorithm.gamma"
        raise WheellegError(f"no run has '{key}'", key=where, expected=expected, nearest=nearest_name(key, _TOLD))
    return found


def _at(config: Any, key: str) -> Any:
    for part in key.split("."):
        config = config.get(part) if isinstance(config, Mapping) else None
    return config


def _require_ordered(key: str, known: Sequence[Any], wanted: str) -> None:
    """Raise where all values are words, and so neither smaller nor larger than a number."""
    if known and all(isinstance(value, str) and not _begins_with_digit(value) for value in known):
        raise WheellegError(
            f"'{key}' is text, such as '{known[0]}', and {wanted} a number", key="--filter", expected=f"{key}=TEXT"
        )


def _begins_with_digit(text: str) -> bool:
    """Return whether a text is a date, an id or the like, of which a number such as a year is a beginning."""
    return text[:1].isdigit()


def _holds(value: Any, sign: str, wanted: str) -> bool:
    if sign in _ORDERED:
        number = _number(wanted)
        if isinstance(value, str):
            return (number is None or _begins_with_digit(value)) and _ORDERED[sign](value, wanted)
        if number is None:
            raise WheellegError(f"'{wanted}' is no number", key="--filter", expected=f"KEY{sign}NUMBER")
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
