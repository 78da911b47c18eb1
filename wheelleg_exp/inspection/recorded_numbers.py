"""Recorded numbers: the selected frames of a recording, numbers by typed name, and their statistics.

A typed name is for example ``rewards.base_height``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.inspection.row_selection import Selection, nothing_chosen
from wheelleg_exp.recording.layout import BRANCH, ITERATION, SIM_TIME, STEP, unit
from wheelleg_exp.recording.reading.number_groups import Number
from wheelleg_exp.recording.reading.recording_reader import Event, Recording

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


@dataclass(frozen=True)
class Moment:
    """A moment: control step, simulated time in s, training iteration, and environment; None if unknown."""

    step: int | None
    time_s: float | None
    iteration: int | None = None
    env_id: int | None = None


@dataclass(frozen=True)
class Statistics:
    """Statistics of one number over its finite values; None without any.

    Attributes:
        count: number of values, finite or not.
        nan, infinite: number of NaN and of infinite values.
        mean, std, rms: mean, standard deviation (over n), root mean square.
        minimum, maximum: the extremes.
        quantiles: values by share, interpolated linearly.
        minimum_at, maximum_at: first moments of the extremes.
        first_at, last_at: moments of the first and the last value, finite or not.
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

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics as a plain mapping."""
        return asdict(self)


def statistics(values: NDArray[np.float64], at: Callable[[int], Moment] | None = None) -> Statistics:
    """Return the statistics of ``values`` (n,). ``at`` returns the moment of a row."""
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    kept = values[finite]
    nan = int(np.isnan(values).sum())
    counts = {"count": len(values), "nan": nan, "infinite": len(values) - len(kept) - nan}
    first, last = (at(0), at(len(values) - 1)) if at and len(values) else (None, None)
    if not len(kept):
        nothing = dict.fromkeys(("mean", "std", "rms", "minimum", "maximum", "minimum_at", "maximum_at"))
        return Statistics(**counts, **nothing, quantiles={}, first_at=first, last_at=last)  # type: ignore[arg-type]
    places = np.flatnonzero(finite)
    low, high = places[np.argmin(kept)], places[np.argmax(kept)]
    with np.errstate(over="ignore", invalid="ignore"):  # squares of huge values overflow
        mean, std, rms = float(kept.mean()), float(kept.std()), float(np.sqrt(np.mean(kept**2)))
    return Statistics(
        **counts,
        mean=mean,
        std=std,
        rms=rms,
        minimum=float(values[low]),
        maximum=float(values[high]),
        quantiles=dict(zip(QUANTILES, np.quantile(kept, QUANTILES).tolist(), strict=True)),
        minimum_at=at(int(low)) if at else None,
        maximum_at=at(int(high)) if at else None,
        first_at=first,
        last_at=last,
    )


TIMES = (STEP, SIM_TIME, ITERATION)


@dataclass(frozen=True)
class Frames:
    """Rows of one environment.

    ``table`` has the timelines and one float64 column per number.
    """

    table: pa.Table
    env_id: int | None

    def __len__(self) -> int:
        return self.table.num_rows

    @property
    def names(self) -> list[str]:
        """The names of the numbers."""
        return [name for name in self.table.column_names if name not in TIMES]

    def column(self, name: str) -> NDArray:
        """Return a number or a timeline, (n,)."""
        return np.asarray(self.table.column(name))

    def moment(self, row: int) -> Moment:
        """Return the moment of a row."""
        step, time_s, iteration = (
            self.table.column(name)[row].as_py() if name in self.table.column_names else None for name in TIMES
        )
        return Moment(step, time_s, iteration, self.env_id)

    def filter(self, mask: NDArray[np.bool_]) -> Frames:
        """Return the rows where ``mask`` is true."""
        return Frames(self.table.filter(pa.array(mask)), self.env_id)


@dataclass(frozen=True)
class View:
    """The selected rows of a recording."""

    recording: Recording
    selection: Selection = field(default_factory=Selection)

    @property
    def env_ids(self) -> list[int]:
        """The selected environments."""
        return self.selection.env_ids(self.recording)

    def has(self, group: str, env_id: int) -> bool:
        """Return whether an environment has numbers at a group or entity."""
        branch = self.recording.branch(env_id)
        path = f"{branch}/{group}" if branch else group
        return path in self.recording.groups() or "scalars" in self.recording.columns(path)

    def frames(self, group: str, env_id: int) -> Frames | None:
        """Return the rows of a group of one environment; None if it has no numbers there."""
        if not self.has(group, env_id):
            return None
        return Frames(self.selection.apply(self.recording.numbers(group, env_id)), env_id)

    def names(self, group: str) -> list[str]:
        """Return the names of a group's numbers."""
        frames = self.frames(group, self.env_ids[0])
        return [] if frames is None else frames.names

    def column(self, group: str, name: str) -> NDArray[np.float64]:
        """Return a number over the rows of all selected environments, concatenated."""
        parts = [frames.column(name) for frames in self._all(group) if name in frames.names]
        return np.concatenate(parts) if parts else np.empty(0)

    def moment(self, group: str, row: int) -> Moment:
        """Return the moment of a row of ``column``."""
        for frames in self._all(group):
            if row < len(frames):
                return frames.moment(row)
            row -= len(frames)
        raise IndexError(row)

    def static(self, path: str) -> dict[str, list]:
        """Return the static components at a path of the first selected environment."""
        branch = self.recording.branch(self.env_ids[0])
        return self.recording.static(f"{branch}/{path}" if branch else path)

    def events(self, kind: str) -> list[Event]:
        """Return the recorded messages within the selected rows."""
        found = [event for env_id in self.env_ids for event in self.recording.events(kind, env_id)]
        return [
            event for event in dict.fromkeys(found) if self.selection.has(event.step, event.time_s, event.iteration)
        ]

    def _all(self, group: str) -> Iterator[Frames]:
        for env_id in self.env_ids:
            frames = self.frames(group, env_id)
            if frames is not None:
                yield frames


_SHOWN = 12


def find_number(recording: Recording, name: str, env_id: int | None = None, key: str = "--term") -> Number:
    """Return the number of a name.

    Raises:
        WheellegError: there is none; the error names the nearest one.
    """
    numbers = recording.all_numbers(env_id)
    for word in (name, name.strip("/").replace("/", ".")):
        if word in numbers:
            return numbers[word]
    raise WheellegError(
        f"no number '{name}' was recorded",
        key=key,
        expected=_expected(name, list(numbers)),
        nearest=_nearest(name, list(numbers)),
    )


def frames_for(recording: Recording, names: Iterable[str], selection: Selection, key: str = "--term") -> list[Frames]:
    """Return the selected rows of numbers for each selected environment, by the given names.

    Raises:
        WheellegError: a name or the selection is wrong.
    """
    words, found = list(dict.fromkeys(names)), []
    for env_id in selection.env_ids(recording):
        numbers = [find_number(recording, name, env_id, key) for name in words]
        named = [Number(word, n.entity, n.index) for word, n in zip(words, numbers, strict=True)]
        shared = bool(recording.branch(env_id)) and not any(is_of_env(number) for number in numbers)
        found.append(Frames(selection.apply(recording.columns_of(named)), None if shared else env_id))
        if shared:
            break  # these numbers belong to no environment
    return found


def is_of_env(number: Number) -> bool:
    """Return whether a number belongs to one of several recorded environments."""
    return BRANCH.match(number.entity) is not None


def _expected(name: str, names: list[str]) -> str:
    """Return the names with the same first part, or the first parts of all names."""
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
    """One recorded number: its name and number of rows."""

    name: str
    rows: int


def number_list(recording: Recording, env_id: int | None = None) -> list[NumberEntry]:
    """Return every recorded number of one environment, and those of none.

    Raises:
        RunDirectoryError: that environment was not recorded.
    """
    return [NumberEntry(n.name, recording.count(n.entity)) for n in recording.all_numbers(env_id).values()]


def units(recording: Recording, names: Iterable[str], env_id: int | None = None) -> dict[str, str]:
    """Return the unit of each number that has one, by the given name.

    Raises:
        WheellegError: a name is wrong.
    """
    found = {name: unit(find_number(recording, name, env_id).entity) for name in names}
    return {name: word for name, word in found.items() if word}


def term_statistics(recording: Recording, names: Iterable[str], selection: Selection) -> dict[str, Statistics]:
    """Return the statistics of numbers over all selected environments.

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
