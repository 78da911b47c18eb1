"""Read a robot's log: a table with one row per control step, in CSV, Parquet, or MCAP.

A log has the columns ``time``, one column per component of each reading (``joint_pos.<joint>``, ``base_ang_vel.x``,
``commands.base_velocity.0``), the targets that were sent after these readings (``target_position.<joint>``), and
optionally ``status`` (0: the policy accepted the readings) and ``reset`` (1: an episode starts).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv, parquet

from wheelleg_exp.errors import WheellegError, nearest_name

Numbers = NDArray[np.float64]
TIME, STATUS, RESET = "time", "status", "reset"
TARGETS = ("position", "velocity", "effort")
AXES = {"base_ang_vel": "xyz", "projected_gravity": "xyz", "base_quat": "wxyz"}
_SUFFIXES = (".csv", ".parquet", ".mcap")


class LogError(WheellegError):
    """A robot's log cannot be read, or lacks columns."""


@dataclass(frozen=True)
class RobotLog:
    """The numbers of a robot's log, each (T,) float64, by column name; missing cells are NaN."""

    path: Path
    columns: Mapping[str, Numbers]

    def __len__(self) -> int:
        return len(self.columns[TIME])

    @property
    def time(self) -> Numbers:
        """The time of each row, s, (T,)."""
        return self.columns[TIME]

    def has(self, names: Sequence[str]) -> bool:
        """Return whether the log contains all columns ``names``."""
        return all(name in self.columns for name in names)

    def table(self, names: Sequence[str]) -> Numbers:
        """Return the columns ``names`` as one array (T, len(names)); raise LogError if a column is missing."""
        for name in names:
            if name not in self.columns:
                nearest = nearest_name(name, self.columns)
                raise LogError(f"the log has no column '{name}'", key=str(self.path), expected=name, nearest=nearest)
        return np.stack([self.columns[name] for name in names], axis=1) if names else np.empty((len(self), 0))

    def complete_table(self, names: Sequence[str]) -> Numbers:
        """Return ``table(names)``; raise LogError if a cell is empty."""
        found = self.table(names)
        for row, column in np.argwhere(~np.isfinite(found))[:1]:
            message = f"the column '{names[column]}' has no number in row {row}"
            raise LogError(message, key=str(self.path), expected="a number in every row")
        return found

    def targets(self, kind: str, joint_names: Sequence[str]) -> Numbers:
        """Return the targets ``position``, ``velocity``, or ``effort`` of the joints, (T, J); 0 without a column."""
        missing = np.zeros(len(self))
        return np.stack([self.columns.get(f"target_{kind}.{name}", missing) for name in joint_names], axis=1)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Whether the policy accepted the readings of each row, (T,)."""
        return self.columns.get(STATUS, np.zeros(len(self))) == 0

    def starts(self, step_dt: float) -> NDArray[np.bool_]:
        """Return the rows that do not continue the previous row: a reset, or a time step far from ``step_dt``, (T,)."""
        late = np.abs(np.diff(self.time, prepend=-np.inf) - step_dt) > 0.5 * step_dt
        return late | (self.columns.get(RESET, np.zeros(len(self))) > 0)


def columns_of(reading: str, width: int, joint_names: Sequence[str]) -> list[str]:
    """Return the names of the columns that contain a reading of ``width`` numbers."""
    if reading.startswith("joint_"):
        return [f"{reading}.{name}" for name in joint_names]
    return [f"{reading}.{part}" for part in AXES.get(reading, range(width))]


def noise_of(values: Numbers, axes: tuple[int, ...] = (0,)) -> Numbers:
    """Return the standard deviation of white noise over ``axes`` from third differences along time, the first axis.

    The third difference of white noise has 1 + 9 + 9 + 1 = 20 times its variance; slow motion almost vanishes in it.
    The median of the square of a normal number is 0.4549. NaN is ignored.
    """
    noise: Numbers = np.sqrt(np.nanmedian(np.diff(values, n=3, axis=0) ** 2, axis=axes) / 0.4549 / 20)
    return noise


def read_log(path: Path) -> RobotLog:
    """Read a log; raise LogError if the file is not a log in CSV, Parquet, or MCAP with at least two rows."""
    if path.suffix.lower() not in _SUFFIXES:
        raise LogError(f"'{path}' is not a robot's log", expected="a file that ends with " + ", ".join(_SUFFIXES))
    if not path.is_file():
        raise LogError(f"there is no file '{path}'", expected="a robot's log")
    try:
        if path.suffix.lower() == ".mcap":
            table = pa.Table.from_pylist(list(_mcap_rows(path)))
        else:
            table = csv.read_csv(path) if path.suffix.lower() == ".csv" else parquet.read_table(path)
        columns = {name: _numbers(table[name], name, path) for name in table.column_names}
    except (pa.ArrowException, ValueError, OSError, KeyError) as error:  # KeyError: two columns with one name
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise LogError(f"the log cannot be read: {reason}", key=str(path)) from error
    if TIME not in columns or len(columns[TIME]) < 2:
        raise LogError("the log needs the column 'time' and at least two rows", key=str(path))
    if not np.isfinite(columns[TIME]).all():
        raise LogError("the column 'time' contains a value that is not finite", key=str(path), expected="seconds")
    return RobotLog(path, columns)


def _numbers(column: Any, name: str, path: Path) -> Numbers:
    try:
        numbers = pc.cast(column, pa.float64()).to_numpy().astype(np.float64)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise LogError(f"the column '{name}' contains text", key=str(path), expected="numbers") from error
    if np.isinf(numbers).any():
        message = f"the column '{name}' contains inf in row {int(np.isinf(numbers).argmax())}"
        raise LogError(message, key=str(path), expected="finite numbers, or empty cells")
    return numbers


def _mcap_rows(path: Path) -> Iterator[dict[str, Any]]:
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError as error:
        expected = "pip install 'wheelleg_exp[mcap]', or a log in CSV or Parquet"
        raise LogError("MCAP logs need the package mcap, which is not installed", expected=expected) from error
    with path.open("rb") as stream:
        try:
            for _, channel, message in make_reader(stream).iter_messages():
                row = json.loads(message.data) if channel.message_encoding == "json" else None
                if isinstance(row, dict) and TIME in row:
                    yield row
        except McapError as error:
            raise LogError(f"the file is not an MCAP log: {error}", key=str(path)) from error
