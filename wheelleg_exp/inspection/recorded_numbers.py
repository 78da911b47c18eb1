"""Recorded numbers: selected frames, numbers by name such as ``rewards.base_height``, and their statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.inspection.row_selection import Selection, nothing_chosen
from wheelleg_exp.recording.layout import BRANCH, STEP, unit
from wheelleg_exp.recording.reading.arrow_values import TIMELINES
from wheelleg_exp.recording.reading.recording_reader import Event, Number, Recording

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


@dataclass(frozen=True)
class Moment:
    """A recorded row's control step, simulated time in s, training iteration, and environment; None if unknown."""

    step: int | None
    time_s: float | None
    iteration: int | None = None
    env_id: int | None = None


@dataclass(frozen=True)
class Statistics:
    """Statistics of the finite values of one recorded number; the mean, for example, is None without finite values.

    ``count``, ``first_at``, and ``last_at`` include values that are not finite. The standard deviation of n values has
    the divisor n, not n - 1. ``quantiles`` maps each share, such as 0.95, to the linearly interpolated quantile.
    ``minimum_at`` and ``maximum_at`` are the moments at which the number's minimum and maximum were first recorded.
    """

    count: int
    nan: int
    infinite: int
    mean: float | None
    std: float | None
    rms: float | None
    minimum: float | None
    maximum: float | None
    quantiles: dict[float, float]
    minimum_at: Moment | None
    maximum_at: Moment | None
    first_at: Moment | None
    last_at: Moment | None


def statistics(values: NDArray[np.float64], at: Callable[[int], Moment] | None = None) -> Statistics:
    """Return the statistics of recorded ``values``, (n,); ``at`` returns the moment of the value with a given index."""
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    kept = values[finite]
    nan = int(np.isnan(values).sum())
    counts = (len(values), nan, len(values) - len(kept) - nan)
    first, last = (at(0), at(len(values) - 1)) if at and len(values) else (None, None)
    if not len(kept):
        return Statistics(*counts, None, None, None, None, None, {}, None, None, first, last)
    places = np.flatnonzero(finite)
    low, high = places[np.argmin(kept)], places[np.argmax(kept)]
    with np.errstate(over="ignore", invalid="ignore"):  # Suppress numpy's warning that a square overflows.
        mean, std, rms = float(kept.mean()), float(kept.std()), float(np.sqrt(np.mean(kept**2)))
    quantiles = dict(zip(QUANTILES, np.quantile(kept, QUANTILES).tolist(), strict=True))
    low_at, high_at = (at(int(low)), at(int(high))) if at else (None, None)
    extremes = (float(values[low]), float(values[high]))
    return Statistics(*counts, mean, std, rms, *extremes, quantiles, low_at, high_at, first, last)


@dataclass(frozen=True)
class Frames:
    """Recorded rows of one environment. The columns of ``table`` are timelines and recorded numbers (float64)."""

    table: pa.Table
    env_id: int | None

    def __len__(self) -> int:
        return int(self.table.num_rows)

    @property
    def names(self) -> list[str]:
        return [name for name in self.table.column_names if name not in TIMELINES]

    @property
    def steps(self) -> NDArray[np.int64]:
        """The control step of each frame, (n,)."""
        return np.asarray(self.table.column(STEP))

    def column(self, name: str) -> NDArray[np.float64]:
        """Return the n values, (n,), of the recorded number with the given name."""
        return np.asarray(self.table.column(name))

    def moment(self, row: int) -> Moment:
        """Return the control step, simulated time, and training iteration at which a row was recorded."""
        present = self.table.column_names
        step, time, iteration = (self.table.column(n)[row].as_py() if n in present else None for n in TIMELINES)
        return Moment(step, time, iteration, self.env_id)

    def filter(self, mask: NDArray[np.bool_]) -> Frames:
        return Frames(self.table.filter(pa.array(mask)), self.env_id)


@dataclass(frozen=True)
class View:
    """Reads the rows of a recording that ``selection`` includes, such as the rows of one environment."""

    recording: Recording
    selection: Selection = field(default_factory=Selection)

    @property
    def env_ids(self) -> list[int]:
        return self.selection.env_ids(self.recording)

    def frames(self, group: str, env_id: int) -> Frames | None:
        """Return an environment's selected rows of a group such as ``rewards``; None if the group was not recorded."""
        branch = self.recording.branch(env_id)
        path = f"{branch}/{group}" if branch else group
        if path not in self.recording.groups() and "scalars" not in self.recording.columns(path):
            return None
        return Frames(self.selection.apply(self.recording.numbers(group, env_id)), env_id)

    def names(self, group: str) -> list[str]:
        frames = self.frames(group, self.env_ids[0])
        return [] if frames is None else frames.names

    def column(self, group: str, name: str) -> NDArray[np.float64]:
        """Return the values of a recorded number in the selected rows of all selected environments, concatenated."""
        parts = [frames.column(name) for frames in self._all(group) if name in frames.names]
        return np.concatenate(parts) if parts else np.empty(0)

    def moment(self, group: str, row: int) -> Moment:
        """Return the control step, simulated time, training iteration, and environment of the selected row ``row``."""
        for frames in self._all(group):
            if row < len(frames):
                return frames.moment(row)
            row -= len(frames)
        raise IndexError(row)

    def static(self, path: str) -> dict[str, list[object]]:
        branch = self.recording.branch(self.env_ids[0])
        return self.recording.static(f"{branch}/{path}" if branch else path)

    def events(self, kind: str) -> list[Event]:
        """Return the recorded log messages of one kind within the selected times and environments."""
        found = dict.fromkeys(event for env_id in self.env_ids for event in self.recording.events(kind, env_id))
        return [event for event in found if self.selection.has(event.step, event.time_s, event.iteration)]

    def _all(self, group: str) -> Iterator[Frames]:
        found = (self.frames(group, env_id) for env_id in self.env_ids)
        return (frames for frames in found if frames is not None)


_SHOWN = 12


def find_number(recording: Recording, name: str, env_id: int | None = None, key: str = "--term") -> Number:
    """Return the recorded number with the given name; raise WheellegError if no recorded number has this name."""
    numbers = recording.all_numbers(env_id)
    for word in (name, name.strip("/").replace("/", ".")):
        if word in numbers:
            return numbers[word]
    word = name.replace("/", ".")
    ends = [number for number in numbers if number.endswith(f".{word}")]
    nearest = min(ends, key=len) if ends else nearest_name(word, list(numbers))
    below = [n for n in numbers if n.startswith(f"{word.split('.')[0]}.")]
    shown = below or [f"{top}.…" for top in dict.fromkeys(n.split(".")[0] for n in numbers)]
    expected = "one of " + ", ".join(shown[:_SHOWN]) + (f", … ({len(shown)} in all)" if len(shown) > _SHOWN else "")
    raise WheellegError(f"the recording contains no number named '{name}'", key=key, expected=expected, nearest=nearest)


def frames_for(recording: Recording, names: Iterable[str], selection: Selection, key: str = "--term") -> list[Frames]:
    """Return the selected rows of the recorded numbers ``names``, separately for each selected environment."""
    words, found = list(dict.fromkeys(names)), []
    for env_id in selection.env_ids(recording):
        numbers = [find_number(recording, name, env_id, key) for name in words]
        named = [Number(word, n.entity, n.index) for word, n in zip(words, numbers, strict=True)]
        shared = bool(recording.branch(env_id)) and not any(is_of_env(number) for number in numbers)
        found.append(Frames(selection.apply(recording.columns_of(named)), None if shared else env_id))
        if shared:  # Read numbers that all environments share, such as training scalars, only once.
            break
    return found


def is_of_env(number: Number) -> bool:
    """Return whether a recorded number belongs to one environment of a recording with several environments."""
    return BRANCH.match(number.entity) is not None


def units(recording: Recording, names: Iterable[str], env_id: int | None = None) -> dict[str, str]:
    """Return the units of all recorded numbers that have a unit, by the number's name."""
    found = {name: unit(find_number(recording, name, env_id).entity) for name in names}
    return {name: word for name, word in found.items() if word}


def term_statistics(recording: Recording, names: Iterable[str], selection: Selection) -> dict[str, Statistics]:
    """Return the statistics of each recorded number in ``names``, over the selected rows of all environments."""
    return {name: _statistics(recording, name, selection) for name in names}


def _statistics(recording: Recording, name: str, selection: Selection) -> Statistics:
    parts = frames_for(recording, [name], selection)
    if not any(map(len, parts)) and not selection.is_all:
        raise nothing_chosen(recording)
    ends = np.cumsum([len(frames) for frames in parts])

    def at(row: int) -> Moment:
        part = int(np.searchsorted(ends, row, side="right"))
        return parts[part].moment(row - int(ends[part]) + len(parts[part]))

    return statistics(np.concatenate([frames.column(name) for frames in parts]), at)
