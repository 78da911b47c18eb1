import gzip
import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from inspection.synthetic import Writer, play

from wheelleg_exp.cli.main import main
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.inspection.recording_summary import summarize
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.reading.recording_repair import repair
from wheelleg_exp.recording.rrd_file import INDEX, ROWS, RrdFile

HEADER = b"RRF2\0\x29\0\0\1\2\0\0"
HEAD = 16  # bytes before the payload of an rrd message


@pytest.fixture(scope="module")
def whole() -> bytes:
    return gzip.decompress(Path(__file__).with_name("play.rrd.gz").read_bytes())


def written(tmp_path, data):
    path = tmp_path / "damaged.rrd"
    path.write_bytes(data)
    return path


def damaged(tmp_path, whole):
    path = written(tmp_path, whole)
    message = [m for m in RrdFile(path).messages() if m.kind == ROWS][3]
    data = bytearray(whole)
    data[message.begin + HEAD : message.end] = bytes(message.end - message.begin - HEAD)
    return written(tmp_path, bytes(data))


def verified(path):
    rerun = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
    words = [sys.executable, "-c", rerun, "rrd", "verify", str(path)]
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "cannot read"),
        (Path.mkdir, "is a folder"),
        (os.mkfifo, "not a regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "not a regular file"),
        (lambda path: path.write_bytes(b""), "is empty"),
        (lambda path: path.write_bytes(b"%PDF-1.7 and more"), "is not a Rerun recording"),
        (lambda path: path.write_bytes(b"RRF0 and more"), "another format.*RRF0"),
        (lambda path: path.write_bytes(b"RRF2\0"), "has an incomplete header"),
        (lambda path: path.write_bytes(HEADER), "contains no rows"),
        (lambda path: path.write_bytes(b"RRF2\0\x16\1\0\1\1\0\0 more"), r"Rerun 0\.22\.1, in a format that is no"),
        (lambda path: rr.blueprint.Blueprint(rr.blueprint.TimeSeriesView()).save("x", path), "contains no rows"),
    ],
)
def test_what_is_not_a_recording_is_an_error_for_people(tmp_path, make, said):
    make(tmp_path / "r.rrd")
    with pytest.raises(RunDirectoryError, match=said):
        Recording(tmp_path / "r.rrd")


def test_an_unknown_message_of_a_newer_rerun_names_that_rerun(tmp_path, whole):
    newer = bytearray(b"RRF2\0\x63\0\0\1\2\0\0" + whole[12:])
    assert Recording(written(tmp_path, bytes(newer))).health.writer == "0.99.0"
    for message in [m for m in RrdFile(written(tmp_path, bytes(newer))).messages() if m.kind == ROWS]:
        newer[message.begin + HEAD] = 0x3A  # the number of the first protobuf field
    with pytest.raises(RunDirectoryError, match=r"contains no rows|rerun rrd migrate"):
        Recording(written(tmp_path, bytes(newer)))


def test_a_file_with_several_recordings_asks_which(tmp_path):
    one, two = play(tmp_path / "1.rrd", recording_id="one"), play(tmp_path / "2.rrd", recording_id="two")
    merged = tmp_path / "merged.rrd"
    words = [sys.executable, "-m", "rerun_cli", "rrd", "merge", str(one), str(two), "-o", str(merged)]
    subprocess.run(words, check=True, capture_output=True)
    said = r"contains 2 recordings; expected one; choose it by its id \(--id\): one, two"
    with pytest.raises(RunDirectoryError, match=said):
        Recording(merged)
    assert Recording(merged, recording_id="two").recording_id == "two"
    with pytest.raises(RunDirectoryError, match="contains no recording 'three'; expected one of one, two"):
        Recording(merged, recording_id="three")


def test_a_recording_of_another_tool_is_read(tmp_path):
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


def test_the_fixed_recording_is_the_synthetic_one(tmp_path, whole):
    fixed = written(tmp_path, whole)
    assert Recording(fixed).health.lines() == ["whole"]
    assert repair(fixed).output is None
    assert [path.name for path in tmp_path.iterdir()] == ["damaged.rrd"]
    assert entity_digests(fixed, without=()) == entity_digests(play(tmp_path / "r.rrd"), without=())


@pytest.mark.parametrize("share", np.linspace(0.1, 0.99, 8))
def test_a_file_that_was_cut_off_is_read_up_to_its_last_whole_message(tmp_path, whole, share):
    cut = int(len(whole) * share)
    recording = Recording(written(tmp_path, whole[:cut]))
    health = recording.health
    assert (health.is_whole, health.damaged) == (False, 0)
    assert health.readable <= cut
    assert "cut off at byte" in health.lines()[1] or health.readable == cut
    complete = Recording(written(tmp_path, whole))
    for entity in recording.entities():
        if recording.has_rows(entity):
            rows = recording.rows(entity)
            assert rows.equals(complete.rows(entity).slice(0, len(rows)))


def test_a_damaged_message_is_left_out_and_counted(tmp_path, whole):
    recording = Recording(damaged(tmp_path, whole))
    assert recording.health.damaged == 1
    assert f"1 of {recording.health.messages} messages are damaged" in recording.health.lines()[1]
    path = tmp_path / "whole.rrd"
    path.write_bytes(whole)
    entities = set(entity_digests(path, without=()))
    assert len(entities - set(entity_digests(recording.path, without=()))) == 1


@pytest.mark.parametrize("seed", range(3))
def test_changed_bytes_give_an_answer_or_an_error_for_people(tmp_path, whole, seed):
    chance = random.Random(seed)
    for _ in range(8):
        data = bytearray(whole)
        for _ in range(chance.choice([1, 1, 10, 200])):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        try:
            summarize(Recording(written(tmp_path, bytes(data)))).as_dict()
        except RunDirectoryError:
            continue


@pytest.mark.parametrize("make", ["cut off", "damaged"])
def test_a_repaired_recording_has_every_readable_row_and_passes_reruns_own_check(tmp_path, whole, make):
    path = damaged(tmp_path, whole) if make == "damaged" else written(tmp_path, whole[: len(whole) * 6 // 10])
    before = path.read_bytes()
    assert not verified(path) or make == "damaged"
    done = repair(path)
    assert done.output == tmp_path / "damaged.repaired.rrd"
    assert verified(done.output)
    assert Recording(done.output).health.lines() == ["whole"]
    assert entity_digests(done.output, without=()) == entity_digests(path, without=())
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["damaged.repaired.rrd", "damaged.rrd"]


def test_a_repair_overwrites_nothing(tmp_path, whole):
    path = written(tmp_path, whole[: len(whole) // 2])
    (tmp_path / "damaged.repaired.rrd").write_text("precious")
    for output in (None, path):
        with pytest.raises(RunDirectoryError, match="exists and is not overwritten"):
            repair(path, output)
    assert (tmp_path / "damaged.repaired.rrd").read_text() == "precious"
    assert repair(path, tmp_path / "new" / "other.rrd").output == tmp_path / "new" / "other.rrd"


def test_an_index_ends_the_messages(tmp_path, whole):
    file = RrdFile(written(tmp_path, whole))
    *_, last = file.messages()
    assert (last.kind, file.is_closed(last), file.is_followed_by_damage(last)) == (INDEX, True, False)
    assert RrdFile(written(tmp_path, whole + bytes(90))).is_followed_by_damage(last)


def test_names_in_a_recording_cannot_leave_the_export_folder_or_control_a_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    writer = Writer(tmp_path / "x.rrd")
    writer.numbers(r"\/tmp\/outside/b", [1.0])
    writer.numbers(r"a\/..\/b/c", [2.0])
    writer.words("log/events", [(1, "\x1b]0;owned\x07\x1b[2J", "INFO")])
    writer.close()
    assert main(["inspect", "x.rrd", "--export", "parquet", "-o", "out"]) == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["%2ftmp%2foutside.parquet", "a%2f.parquet"]
    assert main(["inspect", "x.rrd"]) == 0
    assert "\x1b" not in capsys.readouterr().out
