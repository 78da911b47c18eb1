"""A log is read equally from CSV, Parquet, and MCAP; a file that is not a log is one message."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from wheelleg_exp.robot_logs.robot_log import LogError, read_log

from .made import Columns

COLUMNS = {"time": np.arange(5) / 60, "joint_pos.a": np.linspace(-1, 1, 5), "status": np.zeros(5)}


def write_csv(path: Path, columns: Columns) -> Path:
    csv.write_csv(pa.table(columns), path)
    return path


def write_parquet(path: Path, columns: Columns) -> Path:
    parquet.write_table(pa.table(columns), path)
    return path


def write_mcap(path: Path, columns: Columns) -> Path:
    writer_module = pytest.importorskip("mcap.writer")
    with path.open("wb") as stream:
        writer = writer_module.Writer(stream)
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


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("log.txt", "time\n1\n", "is not a robot's log"),
        ("log.csv", "", "cannot be read"),
        ("log.csv", "time,a\n0,x\n1,y\n", "column 'a' contains text"),
        ("log.csv", "a\n0\n1\n", "needs the column 'time'"),
        ("log.csv", "time\n0\n\n1\nnan\n", "not finite"),
        ("log.parquet", "time\n0\n1\n", "cannot be read"),
        ("log.mcap", "time\n0\n1\n", "not an MCAP log"),
        ("log.csv", None, "there is no file"),
    ],
)
def test_a_file_that_is_not_a_log_is_refused(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(LogError, match=words):
        read_log(tmp_path / name)
