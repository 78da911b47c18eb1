"""Recorded numbers one by one: what there is, and the statistics of some."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.inspection.names import find_number, frames_for
from wheelleg_exp.inspection.selection import Selection, nothing_chosen
from wheelleg_exp.inspection.statistics import Moment, Statistics, statistics
from wheelleg_exp.recording.layout import unit
from wheelleg_exp.recording.reader import Recording


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
