import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.rerun_program import optimize_recording, rerun_program
from wheelleg_exp.recording.rrd_file import APPLICATION, BLUEPRINT_ACTIVATION, RrdFile
from wheelleg_exp.recording.writing.recording_file import RecordingFile

STEPS = np.array([1, 2, 3])
TIMES = [
    rr.TimeColumn("step", sequence=STEPS),
    rr.TimeColumn("sim_time", duration=(STEPS * 1_000_001).astype("timedelta64[ns]")),
]
STATIC = {
    "/": [rr.ViewCoordinates.RIGHT_HAND_Z_UP],
    "world/base": [
        rr.Boxes3D(half_sizes=[[1, 2, 3]], colors=[(1, 2, 3)], fill_mode="solid"),
        rr.Transform3D(translation=[1, 0, 0]),
        rr.CoordinateFrame("tf#/world/base"),
    ],
    "world/mesh": [rr.Mesh3D(vertex_positions=np.eye(3), triangle_indices=[[0, 1, 2]])],
    rr.escape_entity_path_part("a b/ü"): [rr.TextDocument("text", media_type=rr.MediaType.MARKDOWN)],
    "rewards": [rr.AnyValues(terms=["a", "ü"], weights=[1.0, -0.5], many=[1, 2], none=[])],
    "base": [rr.SeriesLines(names=["x"], colors=[(9, 9, 9)]), rr.SeriesPoints(marker_sizes=[4.0])],
}


def columns():
    return {
        "base/height": rr.Scalars.columns(scalars=[0.1, 0.2, 0.3]),
        "contacts": rr.Scalars.columns(scalars=np.arange(6.0)).partition([2, 2, 2]),
        "arrows": rr.Arrows3D.columns(vectors=np.ones((3, 3))).partition([0, 1, 2]),
        "world/base": rr.Transform3D.columns(translation=np.eye(3), quaternion=np.ones((3, 4))),
        "log/events": rr.TextLog.columns(text=["a", "b", "c"], level=["INFO", "WARN", "INFO"]),
    }


def layout():
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="/"), rrb.TimeSeriesView(origin="base")))


def written(path: Path) -> Path:
    sink = RecordingFile(path, recording_id="r", name="ü")
    sink.property("wheelleg", {"seed": 3, "words": ["a"]})
    for entity, archetypes in STATIC.items():
        sink.static(entity, *archetypes)
    for entity, found in columns().items():
        sink.columns(entity, TIMES, found)
    sink.blueprint(layout())
    sink.close()
    assert sink.unfinished is None
    return path


def written_by_rerun(path: Path) -> Path:
    stream = rr.RecordingStream(APPLICATION, recording_id="r", send_properties=False)
    stream.save(path)
    stream.send_recording_name("ü")
    stream.send_property("wheelleg", rr.AnyValues(seed=3, words=["a"]))
    for entity, archetypes in STATIC.items():
        stream.log(entity, *archetypes, static=True)
    for entity, found in columns().items():
        stream.send_columns(entity, TIMES, found)
    stream.send_blueprint(layout())
    stream.flush()
    stream.disconnect()
    assert optimize_recording(path) is None
    return path


def rerun(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([rerun_program(), "rrd", *words], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("both")
    return written(folder / "ours.rrd"), written_by_rerun(folder / "reruns.rrd")


def test_a_file_holds_what_reruns_own_stream_writes(both):
    ours, reruns = both
    assert entity_digests(ours, without=()) == entity_digests(reruns, without=())
    assert Recording(ours).properties == Recording(reruns).properties
    for words in (["compare", "--unordered", str(ours), str(reruns)], ["verify", str(ours)]):
        done = rerun(*words)
        assert done.returncode == 0, done.stderr


def test_the_layout_is_the_one_that_rerun_writes(both):
    def rows(path: Path) -> list[tuple[str, list[tuple[str, str]]]]:
        reader = RrdReader(path)
        chunks = reader.stream(store=reader.blueprints()[0])
        columns = [(chunk.entity_path.split("/")[1], chunk.to_record_batch().schema) for chunk in chunks]
        return sorted((root, [(f.name, str(f.type)) for f in schema if ":" in f.name]) for root, schema in columns)

    assert rows(both[0]) == rows(both[1])
    assert [sum(m.kind == BLUEPRINT_ACTIVATION for m in RrdFile(path).messages()) for path in both] == [1, 1]


def test_columns_of_different_lengths_are_refused(tmp_path):
    sink = RecordingFile(tmp_path / "r.rrd", recording_id="r", name="n")
    with pytest.raises(ValueError, match="length"):
        sink.columns("a", TIMES, rr.Scalars.columns(scalars=[1.0, 2.0]))
    sink.abandon()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "r.rrd").write_bytes(b"mine")
    with pytest.raises(RunDirectoryError, match="exists and is not overwritten"):
        RecordingFile(tmp_path / "r.rrd", recording_id="r", name="n")
    with pytest.raises(RunDirectoryError, match="cannot write"):
        RecordingFile(tmp_path / "r.rrd" / "below.rrd", recording_id="r", name="n")
    assert (tmp_path / "r.rrd").read_bytes() == b"mine"


def test_recordings_of_one_name_have_ids_of_their_own(tmp_path):
    paths = [tmp_path / run / "2026-01-01_00-00-00" / "recording.rrd" for run in ("a", "b")]
    for path in paths:
        RecordingFile(path, recording_id="2026-01-01_00-00-00", name="n").close()
    first, second = (Recording(path).recording_id for path in paths)
    assert first != second
    assert {len(first), first[:19]} == {28, "2026-01-01_00-00-00"}


def test_what_was_flushed_is_in_the_file_and_what_was_not_is_not(tmp_path):
    sink = RecordingFile(tmp_path / "r.rrd", recording_id="r", name="n")
    sink.columns("a", TIMES, rr.Scalars.columns(scalars=[1.0, 2.0, 3.0]))
    assert "a" not in Recording(tmp_path / "r.rrd").entities()
    sink.flush()
    recording = Recording(tmp_path / "r.rrd")
    assert recording.values("a").ravel().tolist() == [1.0, 2.0, 3.0]
    assert not recording.health.is_closed
    sink.close()
    assert Recording(tmp_path / "r.rrd").health.is_whole


def test_a_full_disk_is_reported_and_complete_data_stays(tmp_path, monkeypatch):
    sink = RecordingFile(tmp_path / "r.rrd", recording_id="r", name="n")
    real = os.write

    def write(descriptor: int, data: memoryview) -> int:
        if len(data) < 100:
            raise OSError(28, "No space left on device")
        return real(descriptor, data[:100])

    monkeypatch.setattr("wheelleg_exp.recording.writing.recording_file.os.write", write)
    sink.columns("a", TIMES, rr.Scalars.columns(scalars=[1.0, 2.0, 3.0]))
    with pytest.raises(SimulationFailure, match=r"r\.rrd': no space left on device; expected room") as caught:
        sink.flush()
    assert caught.value.exit_code == 3
    sink.close()
    assert sink.unfinished is None
    assert Recording(tmp_path / "r.rrd").entities() == []
