"""Provide the numbers of a recording for plots, by Rerun entity, and find recorded sequences of control steps."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.inspection.row_selection import Selection
from wheelleg_exp.plain_data import Unreadable, yaml_value
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP, TRAINING, join, unescaped
from wheelleg_exp.recording.reading.arrow_values import as_number
from wheelleg_exp.recording.reading.recording_reader import Recording, parts_of

Numbers = NDArray[np.float64]
Points = tuple[Sequence[int] | NDArray[np.int64], Sequence[float] | Numbers]  # iterations and values of a curve
Scalars = Mapping[str, Points]
_LARGEST = 1e100
_SHOWN_SAMPLES = 4
_LONGEST_CONFIG = 1 << 20  # characters


@dataclass(frozen=True)
class Series:
    """Numbers over time: control steps (n,), times in s (n,), training iterations (n,) or None, values (n, width)."""

    step: NDArray[np.int64]
    time: Numbers
    iteration: NDArray[np.int64] | None
    values: Numbers
    names: tuple[str, ...]

    def rows(self, which: NDArray[np.intp] | NDArray[np.bool_]) -> Series:
        """Return a copy of the series that contains only the rows ``which``, given as indices or as a boolean mask."""
        iteration = None if self.iteration is None else self.iteration[which]
        return Series(self.step[which], self.time[which], iteration, self.values[which], self.names)

    @property
    def first(self) -> Numbers:
        """The first number in each of the n recorded rows, (n,)."""
        return self.values[:, 0]


@dataclass(frozen=True)
class Sample:
    """Recorded control steps without a gap; ``iteration`` is that of the ``first`` step, None without a training."""

    first: int
    last: int
    iteration: int | None

    def of(self, series: Series) -> Series:
        """Return the rows of ``series`` from the control step ``first`` to the control step ``last``."""
        return series.rows((series.step >= self.first) & (series.step <= self.last))


class Source:
    """Provides the data of a recording for plots of one environment, by default the selected or the first one."""

    def __init__(self, recording: Recording, env: int | None = None, selection: Selection | None = None) -> None:
        self.recording = recording
        self.selection = selection or Selection()
        env = self.selection.env_id if env is None else env
        self.env_id = recording.env_ids[0] if env is None else env
        self._entities = recording.entities()
        self.branch = recording.branch(env)
        self.config = _config(recording)

    @property
    def whose(self) -> str:
        """The name of the plotted environment; an empty text if only one environment was recorded."""
        return f"environment {self.env_id}" if len(self.recording.env_ids) > 1 else ""

    def path(self, *parts: str) -> str:
        """Join names to the path of a Rerun entity of the plotted environment, such as ``env_3/base/height``."""
        return join(self.branch, *parts)

    def below(self, *parts: str) -> list[str]:
        """Return the names of a Rerun entity's children, such as all joints, in the recorded order if there is one."""
        root = self.path(*parts)
        found, statics = self.children(root), self.recording.static(root)
        order = [str(name) for name in statics.get("terms", statics.get("names", []))]
        return sorted(found, key=lambda name: order.index(name) if name in order else len(order))

    def children(self, root: str) -> list[str]:
        head = f"{root}/"
        tails = (e.removeprefix(head) for e in self._entities if e.startswith(head))
        return list(dict.fromkeys(unescaped(tail.split("/")[0]) for tail in tails))

    def find(self, term: str) -> str | None:
        """Return the entity of a dotted name, None if unknown; a training scalar's name can omit ``training.``."""
        parts = [unescaped(part) for part in parts_of(term)] if "/" in term else term.split(".")
        for entity in (self.path(*parts), join(*parts), join(TRAINING, *parts)):
            if self.recording.has_rows(entity):
                return entity
        return None

    def series(self, entity: str) -> Series:
        """Return the selected numbers of a Rerun entity; raise RunDirectoryError if the selection has no numbers."""
        found = self._series(entity)
        if not found.values.size:
            raise RunDirectoryError(f"no selected row of '{self.recording.path}' contains '{entity}'")
        return found

    def _series(self, entity: str) -> Series:
        values = drawable(self.recording.values(entity))
        table = self.recording.table(entity)
        names = self.recording.names(entity) or [entity.rsplit("/", 1)[-1]]
        names += [f"{names[0]}[{i}]" for i in range(len(names), values.shape[1])]
        iteration = _integers(table, ITERATION) if ITERATION in table.column_names else None
        steps = _integers(table, STEP) if STEP in table.column_names else np.arange(len(table))
        found = Series(steps, seconds(table), iteration, values, tuple(names[: values.shape[1]]))
        return found.rows(chosen_rows(self.selection, found.step, found.time, found.iteration))

    def maybe(self, *parts: str) -> Series | None:
        """Return the selected rows of a Rerun entity's numbers; None if no selected row contains such numbers."""
        entity = self.path(*parts)
        found = self._series(entity) if self.recording.is_numeric(entity) else None
        return found if found is not None and found.values.size else None

    def training(self) -> dict[str, Points]:
        """Return each training scalar's iterations and values as a dictionary with keys such as ``Loss/value``."""
        head = f"{TRAINING}/"
        found: dict[str, Points] = {}
        numeric = (e for e in self._entities if e.startswith(head) and self.recording.is_numeric(e))
        for entity in numeric:
            series = self._series(entity)
            if series.values.size:
                x = series.iteration if series.iteration is not None else series.step
                found[unescaped(entity.removeprefix(head))] = (x, series.first)
        return found

    @property
    def is_training(self) -> bool:
        """Whether the recording contains training scalars, which only a training records."""
        return any(entity.startswith(f"{TRAINING}/") for entity in self._entities)

    def samples(self) -> list[Sample]:
        """Return the groups of consecutive recorded control steps (samples), sorted by time."""
        clock = self.clock()
        if clock is None or not len(clock.step):
            return []
        cuts = [0, *(np.flatnonzero(np.diff(clock.step) > 1) + 1).tolist(), len(clock.step)]
        iterations: list[int | None] = [None] * len(clock.step) if clock.iteration is None else clock.iteration.tolist()
        return [Sample(int(clock.step[a]), int(clock.step[b - 1]), iterations[a]) for a, b in pairwise(cuts)]

    def shown_samples(self) -> list[Sample]:
        """Return up to 4 samples: the first sample, the last sample, and evenly spaced samples in between."""
        samples = self.samples()
        picked = np.linspace(0, len(samples) - 1, min(len(samples), _SHOWN_SAMPLES)).round().astype(int)
        return [samples[i] for i in picked]

    def clock(self) -> Series | None:
        """Return a series, such as ``qpos``, with a row for each recorded control step; None without such a series."""
        for parts in (("state", "qpos"), ("base", "height"), ("rewards", "total")):
            if (series := self.maybe(*parts)) is not None:
                return series
        return None

    def fired(self) -> dict[str, Series]:
        """Return each termination term's recorded values by name; a value above 0 means that the term fired."""
        return self._terms("terminations")

    def ends(self) -> NDArray[np.int64]:
        """Return the control steps at which episodes of the plotted environment ended."""
        steps = [series.step[series.first > 0] for series in self.fired().values()]
        return np.unique(np.concatenate(steps)) if steps else np.empty(0, dtype=np.int64)

    def weighted(self) -> dict[str, Series]:
        """Return the weighted values of each reward term, 1/s, by the term's name, without the sum of all terms."""
        return {name: series for name, series in self._terms("rewards").items() if name != "total"}

    def _terms(self, group: str) -> dict[str, Series]:
        found = {name: self.maybe(group, name) for name in self.below(group)}
        return {name: series for name, series in found.items() if series is not None}

    def target_height(self) -> float | None:
        """Return the base's target height, m, from the recorded reward terms; None if no term has a target height."""
        return target_height(_mapping(self.config.get("env")).get("rewards"))

    def drive(self, joint: str, name: str) -> float | None:
        """Return a property of a joint's actuator, such as ``effort_limit``; None if the property was not recorded."""
        kept = self.recording.static(self.path("joints", joint)).get(name)
        return as_number(kept[0]) if kept else None


def broken(series: Series, ends: NDArray[np.int64], column: int = 0) -> tuple[Numbers, Numbers]:
    """Return the times and values of a plotted line, with NaN wherever an episode or a sequence of steps ends."""
    cuts = np.union1d(np.flatnonzero(np.isin(series.step, ends)), np.flatnonzero(np.diff(series.step) > 1)) + 1
    cuts = cuts[cuts < len(series.step)]
    time = np.insert(series.time, cuts, series.time[cuts] if len(cuts) else [])
    return time, np.insert(series.values[:, column], cuts, np.nan)


def chosen_rows(
    selection: Selection, step: NDArray[np.int64], time: Numbers, iteration: NDArray[np.int64] | None
) -> NDArray[np.intp]:
    """Return the indices of the rows whose time and training iteration ``selection`` includes."""
    columns = {STEP: step, SIM_TIME: time, "row": np.arange(len(step))}
    if iteration is not None:
        columns[ITERATION] = iteration
    return np.asarray(selection.apply(pa.table(columns)).column("row"), dtype=np.intp)


def target_height(rewards: object) -> float | None:
    """Return the base's target height, m, from the config section of the reward terms; None without a target height."""
    heights = (as_number(_mapping(term).get("target_height")) for term in _mapping(rewards).values())
    return next((height for height in heights if height is not None), None)


def drawable(values: ArrayLike) -> Numbers:
    """Replace values that are not finite or too large for a plot axis by NaN."""
    found = np.asarray(values, dtype=np.float64)
    return np.where(np.abs(found) < _LARGEST, found, np.nan)


def mean_of(values: ArrayLike) -> float:
    """Return the mean of the drawable values (finite and not too large for an axis); 0 without drawable values."""
    known = drawable(values)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else 0.0


def seconds(table: pa.Table) -> Numbers:
    """Return the column of simulated times in a table, s; zeros if the table has no such column."""
    if SIM_TIME not in table.column_names:
        return np.zeros(len(table))
    column = table.column(SIM_TIME).combine_chunks()
    if pa.types.is_floating(column.type):
        return np.asarray(column, dtype=np.float64)
    return np.asarray(column.cast(pa.duration("ns")).cast(pa.int64()), dtype=np.float64) / 1e9


def _integers(table: pa.Table, name: str) -> NDArray[np.int64]:
    return np.asarray(table.column(name).combine_chunks().cast(pa.int64()).fill_null(-1), dtype=np.int64)


def _config(recording: Recording) -> Mapping[str, object]:
    text = recording.document("config")
    if text is None or len(text) > _LONGEST_CONFIG:
        return {}
    try:
        return _mapping(yaml_value(re.sub(r"\A```\w*\n|```\s*\Z", "", text.strip())))
    except Unreadable:
        return {}


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}
