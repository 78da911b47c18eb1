"""A log is read equally from CSV, Parquet, and MCAP; a damaged file, or one that is not a log, is one message."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from wheelleg_exp.robot_logs.robot_log import LogError, RobotLog, read_log

from .made import Columns

COLUMNS = {"time": np.arange(5) / 60, "joint_pos.a": np.linspace(-1, 1, 5), "status": np.zeros(5)}


def write_csv(path: Path, columns: Columns) -> Path:
    csv.write_csv(pa.table(columns), path)
    return path


def write_parquet(path: Path, columns: Columns, **options) -> Path:
    parquet.write_table(pa.table(columns), path, **options)
    return path


def write_mcap(path: Path, columns: Columns, compression: str = "ZSTD", **options) -> Path:
    writer_module = pytest.importorskip("mcap.writer")
    with path.open("wb") as stream:
        writer = writer_module.Writer(stream, compression=writer_module.CompressionType[compression], **options)
        writer.start()
        schema = writer.register_schema(name="row", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="log", message_encoding="json", schema_id=schema)
        for row in zip(*columns.values(), strict=True):
            data = json.dumps(dict(zip(columns, map(float, row), strict=True))).encode()
            writer.add_message(channel, log_time=0, publish_time=0, data=data)
        writer.finish()
    return path


@pytest.mark.parametrize("write", [write_csv, write_parquet, write_mcap])
def test_a_log_is_read(tmp_path, write):
    log = read_log(write(tmp_path / f"log.{write.__name__.removeprefix('write_')}", COLUMNS))
    np.testing.assert_equal(dict(log.columns), COLUMNS)
    assert log.starts(1 / 60).tolist() == [True, False, False, False, False]


CHECKED = {
    "snappy.parquet": partial(write_parquet, write_page_checksum=True),
    "rows.parquet": partial(write_parquet, write_page_checksum=True, data_page_version="2.0", row_group_size=20),
    "plain.parquet": partial(write_parquet, write_page_checksum=True, compression="none", use_dictionary=False),
    "none.mcap": partial(write_mcap, compression="NONE", chunk_size=1000),
    "lz4.mcap": partial(write_mcap, compression="LZ4"),
    "zstd.mcap": partial(write_mcap, compression="ZSTD"),
    "data.mcap": partial(write_mcap, use_chunking=False, enable_data_crcs=True),
}


@pytest.mark.parametrize("name", CHECKED)
def test_no_flipped_bit_of_a_file_with_checksums_changes_a_number(tmp_path, name):
    rng = np.random.default_rng(0)
    columns = {"time": np.arange(60) / 60, **{key: rng.standard_normal(60) for key in ("joint_pos.a", "joint_vel.a")}}
    whole, damaged = CHECKED[name](tmp_path / name, columns).read_bytes(), tmp_path / f"damaged_{name}"
    assert read_log(tmp_path / name).is_checked
    messages = []
    for bit in rng.integers(0, 8 * len(whole), 300):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        damaged.write_bytes(content)
        try:
            np.testing.assert_equal(dict(read_log(damaged).columns), columns)
        except LogError as error:
            messages.append(str(error))
    assert len(messages) > 100
    assert all(str(damaged) in message for message in messages)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("log.csv", write_csv),
        ("log.parquet", write_parquet),
        ("log.mcap", partial(write_mcap, enable_crcs=False)),
        ("log.mcap", partial(write_mcap, use_chunking=False)),
    ],
)
def test_a_file_without_checksums_is_not_checked(tmp_path, name, write):
    assert not read_log(write(tmp_path / name, COLUMNS)).is_checked


def test_the_step_ignores_gaps_and_rounding():
    time = np.delete(np.round(np.arange(600) * 1.05 / 60, 3), slice(100, 130))
    assert RobotLog(Path("log.csv"), {"time": time}).step_dt == pytest.approx(1.05 / 60, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("log.txt", "time\n1\n", "is not a robot's log"),
        ("log.csv", "", "cannot be read"),
        ("log.csv", "time,a\n0,x\n1,y\n", "column 'a' contains text"),
        ("log.csv", "a\n0\n1\n", "needs the column 'time'"),
        ("log.csv", "time\n0\n\n1\nnan\n", "not finite"),
        ("log.parquet", "time\n0\n1\n", "cannot be read"),
        ("log.mcap", "time\n0\n1\n", "cannot be read: not a valid MCAP file"),
        ("log.csv", None, "there is no file"),
    ],
)
def test_a_file_that_is_not_a_log_is_refused(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(LogError, match=words):
        read_log(tmp_path / name)


def test_a_small_file_with_many_rows_is_refused(tmp_path):
    table = pa.table({"time": pa.array(np.zeros(2_000_000))})
    with parquet.ParquetWriter(tmp_path / "log.parquet", table.schema) as writer:
        for _ in range(60):
            writer.write_table(table, row_group_size=2_000_000)
    with pytest.raises(LogError, match="120,000,000 rows of 1 columns; expected at most 100,000,000 numbers"):
        read_log(tmp_path / "log.parquet")
