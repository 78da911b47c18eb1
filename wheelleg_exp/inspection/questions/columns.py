"""Recorded numbers one by one, by the names that one types (``rewards.base_height``), and their statistics."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.inspection.questions.selection import Selection, nothing_chosen
from wheelleg_exp.inspection.questions.statistics import Moment, Statistics, statistics
from wheelleg_exp.inspection.questions.view import Frames
from wheelleg_exp.recording.layout import BRANCH, unit
from wheelleg_exp.recording.reading.groups import Number
from wheelleg_exp.recording.reading.reader import Recording

_SHOWN = 12


def find_number(recording: Recording, name: str, env_id: int | None = None, key: str = "--term") -> Number:
    """Return the number of a name.

    Raises:
        WheellegError: there is none, with the nearest that there is.
    """
    numbers = recording.all_numbers(env_id)
    for word in (name, name.strip("/").replace("/", ".")):
        if word in numbers:
            return numbers[word]
    raise WheellegError(
        f"nothing of the name '{name}' was recorded",
        key=key,
        expected=_expected(name, list(numbers)),
        nearest=_nearest(name, list(numbers)),
    )


def frames_for(recording: Recording, names: Iterable[str], selection: Selection, key: str = "--term") -> list[Frames]:
    """Return the chosen rows of numbers, for each chosen environment, by the names that were asked for.

    Raises:
        WheellegError: one of the names is wrong, or the selection is.
    """
    words, found = list(dict.fromkeys(names)), []
    for env_id in selection.env_ids(recording):
        numbers = [find_number(recording, name, env_id, key) for name in words]
        named = [Number(word, n.entity, n.index) for word, n in zip(words, numbers, strict=True)]
        shared = bool(recording.branch(env_id)) and not any(is_of_env(number) for number in numbers)
        found.append(Frames(selection.apply(recording.columns_of(named)), None if shared else env_id))
        if shared:
            break  # these numbers are of no environment
    return found


def is_of_env(number: Number) -> bool:
    """Return whether a number is of one of several recorded environments."""
    return BRANCH.match(number.entity) is not None


def _expected(name: str, names: list[str]) -> str:
    """Return those that begin like the name, or what the names begin with."""
    top = name.replace("/", ".").split(".")[0]
    below = [n for n in names if n.startswith(f"{top}.")]
    shown = below or [f"{top}.…" for top in dict.fromkeys(n.split(".")[0] for n in names)]
    return "one of " + ", ".join(shown[:_SHOWN]) + (f", … ({len(shown)} in all)" if len(shown) > _SHOWN else "")


def _nearest(name: str, names: list[str]) -> str | None:
    word = name.replace("/", ".")
    ends = [n for n in names if n.endswith(f".{word}")]
    return min(ends, key=len) if ends else nearest_name(word, names)


@dataclass(frozen=True)
class NumberEntry:
    """One recorded number: its name, and how many rows it has."""

    name: str
    rows: int


def number_list(recording: Recording, env_id: int | None = None) -> list[NumberEntry]:
    """Return every recorded number of one environment, and of none.

    Raises:
        RunDirectoryError: that environment was not recorded.
    """
    return [NumberEntry(n.name, recording.count(n.entity)) for n in recording.all_numbers(env_id).values()]


def units(recording: Recording, names: Iterable[str], env_id: int | None = None) -> dict[str, str]:
    """Return the unit of each number that has one, by the name that was asked for.

    Raises:
        WheellegError: a name is wrong.
    """
    found = {name: unit(find_number(recording, name, env_id).entity) for name in names}
    return {name: word for name, word in found.items() if word}


def term_statistics(recording: Recording, names: Iterable[str], selection: Selection) -> dict[str, Statistics]:
    """Return the statistics of numbers over all chosen environments.

    Raises:
        WheellegError: a name or the selection is wrong.
    """
    return {name: _statistics(recording, name, selection) for name in names}


def _statistics(recording: Recording, name: str, selection: Selection) -> Statistics:
    parts = frames_for(recording, [name], selection)
    if not any(map(len, parts)) and not selection.is_all:
        raise nothing_chosen(recording)
    values = np.concatenate([frames.column(name) for frames in parts])
    ends = np.cumsum([len(frames) for frames in parts])

    def at(row: int) -> Moment:
        part = int(np.searchsorted(ends, row, side="right"))
        return parts[part].moment(row - int(ends[part]) + len(parts[part]))

    return statistics(values, at)
