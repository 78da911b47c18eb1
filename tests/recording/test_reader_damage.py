"""Files that are no recordings, or not whole."""

from __future__ import annotations

import os
import random
import subprocess
import sys

import numpy as np
import pytest
import rerun as rr
from inspection.synthetic import play
from rrd import healthy

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.inspection.recording_summary import summarize
from wheelleg_exp.recording.reading.messages import ROWS, File, spans
from wheelleg_exp.recording.reading.recording_contents import Contents
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording

MESSAGE = 16  # bytes of a message's head


@pytest.fixture(scope="module")
def whole():
    """The same bytes in every run: each file that rerun writes has others, and so would each damage be another."""
    return healthy()


def written(tmp_path, data):
    path = tmp_path / "damaged.rrd"
    path.write_bytes(data)
    return path


def test_a_missing_file_and_a_folder_are_errors_for_people(tmp_path):
    with pytest.raises(RunDirectoryError, match="cannot read"):
        Recording(tmp_path / "absent.rrd")
    with pytest.raises(RunDirectoryError, match="is a folder"):
        Recording(tmp_path)


def test_a_pipe_is_no_recording_and_does_not_wait(tmp_path):
    os.mkfifo(tmp_path / "pipe.rrd")
    with pytest.raises(RunDirectoryError, match="no ordinary file"):
        Recording(tmp_path / "pipe.rrd")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "empty"),
        (b"%PDF-1.7 and more", "no rerun recording"),
        (b"RRF0 and more", "another format.*RRF0"),
        (b"RRF2\0", "cut off within its header"),
        (b"RRF2\0\x29\0\0\1\2\0\0", "holds no recording"),
    ],
)
def test_a_foreign_an_old_and_an_empty_file_are_errors_for_people(tmp_path, content, said):
    with pytest.raises(RunDirectoryError, match=said):
        Recording(written(tmp_path, content))


def test_a_recording_of_a_rerun_that_wrote_otherwise_names_that_rerun(tmp_path, whole):
    """Byte 4 to 6 of the header are the version, byte 9 says how messages are written."""
    with pytest.raises(RunDirectoryError, match=r"written by rerun 0\.22\.1, in a format that is not read any more"):
        Recording(written(tmp_path, b"RRF2\0\x16\1\0\1\1\0\0" + whole[12:]))
    newer = bytearray(b"RRF2\0\x63\0\0\1\2\0\0" + whole[12:])
    assert Recording(written(tmp_path, bytes(newer))).health.writer == "0.99.0"
    for span in [s for s in spans(File(written(tmp_path, bytes(newer)))) if s.kind == ROWS]:
        newer[span.begin + MESSAGE] = 0x3A  # the first field is another one
    with pytest.raises(RunDirectoryError, match=r"written by rerun 0\.99\.0; expected .*rerun rrd migrate"):
        Recording(written(tmp_path, bytes(newer)))


def test_a_blueprint_is_no_recording(tmp_path):
    import rerun.blueprint as rrb

    rrb.Blueprint(rrb.TimeSeriesView()).save("wheelleg", str(tmp_path / "b.rbl"))
    with pytest.raises(RunDirectoryError, match="holds no recording"):
        Recording(tmp_path / "b.rbl")


def test_a_file_with_several_recordings_asks_which(tmp_path):
    one, two = play(tmp_path / "1.rrd", recording_id="one"), play(tmp_path / "2.rrd", recording_id="two")
    both = tmp_path / "both.rrd"
    both.write_bytes(one.read_bytes() + two.read_bytes()[12:])
    merged = tmp_path / "merged.rrd"
    words = [sys.executable, "-m", "rerun_cli", "rrd", "merge", str(one), str(two), "-o", str(merged)]
    subprocess.run(words, check=True, capture_output=True)
    with pytest.raises(
        RunDirectoryError, match=r"holds 2 recordings; expected one; choose it by its id \(--id\): one, two"
    ):
        Recording(merged)
    assert Recording(merged, recording_id="two").recording_id == "two"
    with pytest.raises(RunDirectoryError, match="no recording 'three'; expected one of one, two"):
        Recording(merged, recording_id="three")


def test_a_recording_of_another_tool_is_opened_with_what_it_holds(tmp_path):
    stream = rr.RecordingStream("another", recording_id="x")
    stream.save(tmp_path / "r.rrd")
    for i in range(5):
        stream.set_time("frame", sequence=i)
        stream.log("camera/exposure", rr.Scalars(0.1 * i))
        stream.log("points", rr.Points3D(np.zeros((3, 3))))
    stream.disconnect()
    recording = Recording(tmp_path / "r.rrd")
    assert recording.purpose is None
    assert recording.entities() == ["camera/exposure", "points"]
    np.testing.assert_allclose(recording.table("camera").column("exposure"), [0.0, 0.1, 0.2, 0.3, 0.4])
    summary = summarize(recording)
    assert (summary.purpose, summary.figures.count, summary.rewards) == (None, 0, [])


@pytest.mark.parametrize("share", np.linspace(0.1, 0.99, 25))
def test_a_file_that_was_cut_off_is_read_as_far_as_it_is_whole(tmp_path, whole, share):
    cut = int(len(whole) * share)
    recording = Recording(written(tmp_path, whole[:cut]))
    health = recording.health
    assert not health.is_whole
    assert health.readable <= cut
    assert "cut off at byte" in health.lines()[1] or health.readable == cut
    complete = Recording(written(tmp_path, whole))
    for entity in recording.entities():
        if recording.has_rows(entity):
            rows = recording.rows(entity)
            assert rows.equals(complete.rows(entity).slice(0, len(rows)))


def test_a_damaged_message_is_left_out_and_told_with_its_place(tmp_path, whole):
    found = [(p.span, entity) for entity, ps in Contents(written(tmp_path, whole)).pieces.items() for p in ps]
    span, entity = next((s, e) for s, e in found if e == "base/pitch")
    data = bytearray(whole)
    data[span.begin + MESSAGE : span.end] = bytes(span.end - span.begin - MESSAGE)
    recording = Recording(written(tmp_path, bytes(data)))
    assert [(d.begin, d.end) for d in recording.health.damaged] == [(span.begin, span.end)]
    assert recording.health.lost == span.end - span.begin
    assert not recording.has_rows(entity)
    assert recording.table("base").column("height").to_pylist() == [0.1] * 200


def test_a_changed_index_is_told(tmp_path, whole):
    data = bytearray(whole)
    data[-200] ^= 1
    health = Recording(written(tmp_path, bytes(data))).health
    assert health.is_closed
    assert not health.is_whole
    assert "the index at the end was changed" in health.lines()[1]


def test_the_fixed_recording_is_the_synthetic_one(tmp_path, whole):
    fixed = written(tmp_path, whole)
    assert Recording(fixed).health.is_whole
    assert entity_digests(fixed, without=()) == entity_digests(play(tmp_path / "r.rrd"), without=())


@pytest.mark.parametrize("seed", range(4))
def test_changed_bytes_never_end_in_anything_but_an_answer_or_an_error_for_people(tmp_path, whole, seed):
    chance = random.Random(seed)
    for _ in range(12):
        data = bytearray(whole)
        for _ in range(chance.choice([1, 1, 10, 200])):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        try:
            summarize(Recording(written(tmp_path, bytes(data)))).as_dict()
        except RunDirectoryError:
            continue
