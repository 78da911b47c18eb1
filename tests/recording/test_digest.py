import numpy as np
import pytest
import rerun as rr
from recording.conftest import record

from wheelleg_exp.recording.reading.recording_digest import entity_digests


def write(path, scalars, splits=(), text="t", label="one", recording_id="a"):
    stream = rr.RecordingStream("x", recording_id=recording_id, send_properties=False)
    stream.save(path)
    for part in np.split(np.arange(len(scalars)), splits):
        time = rr.TimeColumn("step", sequence=part)
        stream.send_columns("a", [time], rr.Scalars.columns(scalars=np.asarray(scalars)[part]))
    stream.log("a", rr.SeriesLines(names=[label]), static=True)
    stream.log("documents/d", rr.TextDocument(text), static=True)
    stream.disconnect()
    return entity_digests(path)


VALUES = [0.1, -0.0, np.nan, 4e9]


def test_two_recordings_of_one_seeded_rollout_have_the_same_digest(make_env, recorded, tmp_path):
    path = tmp_path / "again.rrd"
    record(path, make_env(), recording_id="another", name="other")
    assert path.read_bytes() != recorded[0].read_bytes()
    assert entity_digests(path) == entity_digests(recorded[0])


def test_how_the_rows_were_cut_up_does_not_matter(tmp_path):
    assert write(tmp_path / "1.rrd", VALUES) == write(tmp_path / "2.rrd", VALUES, splits=(1, 3), recording_id="b")


@pytest.mark.parametrize(
    "changed", [[VALUES[0] + 1e-12, *VALUES[1:]], [VALUES[0], 0.0, *VALUES[2:]]], ids=["by 1e-12", "sign of zero"]
)
def test_the_smallest_change_of_a_number_changes_the_digest(tmp_path, changed):
    assert write(tmp_path / "1.rrd", VALUES) != write(tmp_path / "2.rrd", changed)


def test_a_static_change_is_noticed_and_a_text_only_when_asked_for(tmp_path):
    first = write(tmp_path / "1.rrd", VALUES)
    assert write(tmp_path / "2.rrd", VALUES, label="two") != first
    assert write(tmp_path / "3.rrd", VALUES, text="another") == first
    one, three = (entity_digests(tmp_path / f"{i}.rrd", without=()) for i in (1, 3))
    assert one != three
    write(tmp_path / "1.rrd", VALUES)
    write(tmp_path / "2.rrd", [*VALUES[:3], 4e9 + 1])
    one, two = entity_digests(tmp_path / "1.rrd"), entity_digests(tmp_path / "2.rrd")
    assert [entity for entity in one if one[entity] != two[entity]] == ["a"]
