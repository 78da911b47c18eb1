"""Read a robot's log: a table with one row per control step, in CSV, Parquet, or MCAP.

A log has the columns ``time``, one column per component of each reading (``joint_pos.<joint>``, ``base_ang_vel.x``,
``commands.base_velocity.0``), the targets that were sent after these readings (``target_position.<joint>``), and
optionally ``status`` (0: the policy accepted the readings) and ``reset`` (1: an episode starts).
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

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
# The first four fields of a page header in Thrift's compact protocol: integers, of which the fourth is the checksum.
_PAGE_WITH_CHECKSUM = re.compile(rb"(?:\x15[\x80-\xff]*[\x00-\x7f]){4}")
_MOST_NUMBERS = 100_000_000  # numbers in a log


class LogError(WheellegError):
    """A robot's log cannot be read, or lacks columns."""


@dataclass(frozen=True)
class RobotLog:
    """A robot's log, each column (T,) float64 by name, with NaN for missing cells; ``is_checked``: checksums fit."""

    path: Path
    columns: Mapping[str, Numbers]
    is_checked: bool = False

    def __len__(self) -> int:
        return len(self.columns[TIME])

    @property
    def time(self) -> Numbers:
        """The time of each row, s, (T,)."""
        return self.columns[TIME]

    @property
    def step_dt(self) -> float:
        """The mean time between two rows, s, without the gaps of the log."""
        steps = np.diff(self.time)
        typical = np.sort(steps)[len(steps) // 2]
        return float(steps[np.abs(steps - typical) <= 0.5 * abs(typical)].mean())

    def has(self, names: Sequence[str]) -> bool:
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
        return np.asarray(self.columns.get(STATUS, np.zeros(len(self))) == 0)

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
    """Read and check a log; raise LogError for a damaged file, another format, or fewer than two rows."""
    if path.suffix.lower() not in _SUFFIXES:
        raise LogError(f"'{path}' is not a robot's log", expected="a file that ends with " + ", ".join(_SUFFIXES))
    if not path.is_file():
        raise LogError(f"there is no file '{path}'", expected="a robot's log")
    try:
        if path.suffix.lower() == ".csv":
            table, is_checked = csv.read_csv(path), False
        else:
            table, is_checked = _mcap_table(path) if path.suffix.lower() == ".mcap" else _parquet_table(path)
        columns = {name: _numbers(table[name], name, path) for name in table.column_names}
    except LogError:
        raise
    except Exception as error:  # The parsers of damaged files raise errors of many types.
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise LogError(f"the log cannot be read: {reason}", key=str(path)) from error
    if TIME not in columns or len(columns[TIME]) < 2:
        raise LogError("the log needs the column 'time' and at least two rows", key=str(path))
    if not np.isfinite(columns[TIME]).all():
        raise LogError("the column 'time' contains a value that is not finite", key=str(path), expected="seconds")
    return RobotLog(path, columns, is_checked)


def _numbers(column: pa.ChunkedArray, name: str, path: Path) -> Numbers:
    try:
        numbers: Numbers = pc.cast(column, pa.float64()).to_numpy().astype(np.float64)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise LogError(f"the column '{name}' contains text", key=str(path), expected="numbers") from error
    if np.isinf(numbers).any():
        message = f"the column '{name}' contains inf in row {int(np.isinf(numbers).argmax())}"
        raise LogError(message, key=str(path), expected="finite numbers, or empty cells")
    return numbers


def _parquet_table(path: Path) -> tuple[pa.Table, bool]:
    """Return a Parquet file's table, and whether all columns have checksums. Raise LogError if it is damaged."""
    with parquet.ParquetFile(path, page_checksum_verification=True) as file:
        facts, schema = file.metadata, file.schema
        if facts.num_rows * facts.num_columns > _MOST_NUMBERS:  # A small file can repeat a number any number of times.
            message = f"the log has {facts.num_rows:,} rows of {facts.num_columns:,} columns"
            raise LogError(message, key=str(path), expected=f"at most {_MOST_NUMBERS:,} numbers")
        table = file.read()
    saved = (facts.metadata or {}).get(b"ARROW:schema")
    names = pa.ipc.read_schema(pa.py_buffer(base64.b64decode(saved))).names if saved else table.column_names
    groups = [facts.row_group(number) for number in range(facts.num_row_groups)]
    chunks = [(group, schema.column(i), group.column(i)) for group in groups for i in range(facts.num_columns)]
    if names != table.column_names or not all(
        chunk.num_values == group.num_rows
        and chunk.physical_type == column.physical_type
        and (chunk.compression != "UNCOMPRESSED" or chunk.total_compressed_size == chunk.total_uncompressed_size)
        for group, column, chunk in chunks
    ):
        raise LogError("the file is damaged: its footer contradicts itself", key=str(path))
    data, starts = path.read_bytes(), [c.dictionary_page_offset or c.data_page_offset for _, _, c in chunks]
    return table, all(_PAGE_WITH_CHECKSUM.match(data, start) for start in starts)


def _mcap_table(path: Path) -> tuple[pa.Table, bool]:
    """Return the rows of an MCAP file in the order of their time, and whether all rows have checksums."""
    try:
        from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Statistics
        from mcap.stream_reader import StreamReader, breakup_chunk
    except ImportError as error:
        expected = "pip install 'wheelleg_exp[mcap]', or a log in CSV or Parquet"
        raise LogError("MCAP logs need the package mcap, which is not installed", expected=expected) from error
    messages, channels, count, unchecked = list[Message](), dict[int, Channel](), 0, False
    with path.open("rb") as stream:
        reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=path.stat().st_size)
        for record in reader.records:
            inner: list[McapRecord] = breakup_chunk(record, True) if isinstance(record, Chunk) else [record]
            channels |= {part.id: part for part in inner if isinstance(part, Channel)}
            found = [part for part in inner if isinstance(part, Message)]
            count += len(found)
            messages += [part for part in found if channels[part.channel_id].message_encoding == "json"]
            if isinstance(record, Message) or (isinstance(record, Chunk) and record.uncompressed_crc == 0):
                unchecked = True
            elif isinstance(record, DataEnd) and record.data_section_crc:
                unchecked = False
            elif isinstance(record, Statistics) and record.message_count != count:
                message = f"the file is damaged: it has {count} of its {record.message_count} messages"
                raise LogError(message, key=str(path))
    messages.sort(key=lambda message: message.log_time)
    rows = [json.loads(message.data) for message in messages]
    return pa.Table.from_pylist([row for row in rows if isinstance(row, dict) and TIME in row]), not unchecked
