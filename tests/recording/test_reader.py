from __future__ import annotations

import numpy as np
import pytest
import rerun as rr

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.reader import Recording


def write(path, rows, recording_id="a", value=0.5):
    stream = rr.RecordingStream("x", recording_id=recording_id, send_properties=False)
    stream.save(path)
    for start in rows:
        steps = np.arange(start, start + 3)
        columns = rr.Scalars.columns(scalars=np.repeat(steps * value, 2)).partition([2, 2, 2])
        stream.send_columns("a/b", [rr.TimeColumn("step", sequence=steps)], columns)
    stream.log("a/b", rr.SeriesLines(names=["one", "two"]), static=True)
    stream.flush()
    stream.disconnect()
    return path


def test_rows_come_sorted_by_step_whatever_the_order_of_writing(tmp_path):
    recording = Recording(write(tmp_path / "r.rrd", [6, 0, 3]))
    assert recording.table("a/b").column("step").to_pylist() == list(range(9))
    np.testing.assert_array_equal(recording.values("/a/b"), np.repeat(np.arange(9) * 0.5, 2).reshape(9, 2))
    assert recording.names("a/b") == ["one", "two"]
    assert recording.entities() == ["a/b"]
    assert recording.timelines() == ["step"]
    assert recording.recording_id == "a"


def test_a_missing_entity_is_named_with_its_nearest_neighbour(tmp_path):
    with pytest.raises(RunDirectoryError, match="did you mean 'a/b'"):
        Recording(write(tmp_path / "r.rrd", [0])).table("a/bb")


def test_a_missing_file_is_an_error_for_people(tmp_path):
    with pytest.raises(RunDirectoryError, match="cannot read"):
        Recording(tmp_path / "absent.rrd")


@pytest.mark.parametrize(("content", "said"), [(b"", "empty"), (b"%PDF-1.7 and more", "no rerun recording")])
def test_an_empty_and_a_foreign_file_are_errors_for_people(tmp_path, content, said):
    (tmp_path / "r.rrd").write_bytes(content)
    with pytest.raises(RunDirectoryError, match=said):
        Recording(tmp_path / "r.rrd")


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_file_that_was_cut_off_is_an_error_for_people(tmp_path, share):
    data = write(tmp_path / "r.rrd", [0, 3]).read_bytes()
    (tmp_path / "cut.rrd").write_bytes(data[: int(len(data) * share)])
    with pytest.raises(RunDirectoryError, match="damaged"):
        Recording(tmp_path / "cut.rrd")
