import numpy as np
import pytest
import rerun as rr
from inspection.synthetic import STEP_DT, Writer, play, training

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.reading.recording_reader import Recording


def write(path, rows):
    stream = rr.RecordingStream("x", recording_id="a", send_properties=False)
    stream.save(path)
    for start in rows:
        steps = np.arange(start, start + 3)
        columns = rr.Scalars.columns(scalars=np.repeat(steps * 0.5, 2)).partition([2, 2, 2])
        stream.send_columns("a/b", [rr.TimeColumn("step", sequence=steps)], columns)
    stream.log("a/b", rr.SeriesLines(names=["one", "two"]), static=True)
    stream.disconnect()
    return path


def test_rows_come_sorted_by_step_whatever_the_order_of_writing(tmp_path):
    recording = Recording(write(tmp_path / "r.rrd", [6, 0, 3]))
    assert recording.table("a/b").column("step").to_pylist() == list(range(9))
    np.testing.assert_array_equal(recording.values("/a/b"), np.repeat(np.arange(9) * 0.5, 2).reshape(9, 2))
    assert recording.names("a/b") == ["one", "two"]
    assert (recording.entities(), recording.timelines(), recording.recording_id) == (["a/b"], ["step"], "a")
    with pytest.raises(RunDirectoryError, match="did you mean 'a/b'"):
        recording.table("a/bb")


def test_a_group_is_a_table_of_its_numbers_in_the_order_that_the_recording_gives(tmp_path):
    table = Recording(play(tmp_path / "r.rrd")).table("rewards")
    assert table.column_names == ["step", "sim_time", "effort", "alive", "total"]
    assert [str(table.schema.field(name).type) for name in table.column_names] == ["int64", *4 * ["double"]]
    assert table.column("effort").to_pylist() == [-1.0] * 200
    np.testing.assert_allclose(table.column("sim_time"), STEP_DT * np.arange(1, 201), rtol=1e-12)
    recording = Recording(play(tmp_path / "r.rrd"))
    assert recording.table("joints").column_names[2:] == ["hip.effort"]
    assert recording.table("joints/hip").column_names[2:] == ["effort"]
    assert recording.table("contacts").column_names[2:] == ["feet.left", "feet.right"]
    assert {"joints.hip.effort", "contacts.feet.left", "base.pitch"} <= set(recording.all_numbers())
    assert {"rewards", "joints", "joints/hip", "commands/drive"} <= set(recording.groups())


def test_numbers_of_different_steps_stand_in_one_table_with_gaps(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("g/often", [1.0, 2.0, 3.0], steps=[1, 2, 3])
    writer.numbers("g/seldom", [7.0], steps=[2])
    table = Recording(writer.close()).table("g")
    assert table.column("often").to_pylist() == [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(table.column("seldom"), [np.nan, 7.0, np.nan])
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("episode/step", [4.0, 5.0])
    assert Recording(writer.close()).table("episode").column_names == ["step", "sim_time", "episode.step"]


def test_observation_terms_are_joined_in_the_order_of_the_group(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    writer.static("observations/policy", terms=["z", "a"], widths=[2, 1])
    writer.numbers("observations/policy/a", [[5.0], [6.0]], names=["a[0]"])
    writer.numbers("observations/policy/z", [[1.0, 2.0], [3.0, 4.0]], names=["z[0]", "z[1]"])
    recording = Recording(writer.close())
    np.testing.assert_array_equal(recording.values("observations/policy"), [[1, 2, 5], [3, 4, 6]])
    assert recording.names("observations/policy") == ["z[0]", "z[1]", "a"]
    assert "observations.policy.z[1]" in recording.all_numbers()


def test_each_recorded_environment_has_its_own_tables(tmp_path):
    recording = Recording(training(tmp_path / "r.rrd"))
    assert recording.env_ids == [2, 5]
    assert recording.table("base").column("height")[0].as_py() == 0.1
    assert recording.table("base", env_id=5).column("height")[0].as_py() == 1.1
    assert recording.table("env_5/base").column("height")[0].as_py() == 1.1
    assert recording.table("training", env_id=5).column_names[-1] == "Train.mean_reward"
    with pytest.raises(RunDirectoryError, match=r"environment 3 was not recorded.*one of 2, 5"):
        recording.table("base", env_id=3)


def test_words_are_events_by_step(tmp_path):
    recording = Recording(play(tmp_path / "r.rrd"))
    found = [(event.step, event.kind, event.text, event.env_id) for event in recording.events()]
    assert found == [
        (30, "events", "push", 0),
        (50, "episodes", "ended by fallen", 0),
        (120, "events", "push", 0),
        (150, "episodes", "ended by time_out", 0),
    ]
    assert recording.events("episodes")[0].time_s == pytest.approx(1.0)
    assert [event.level for event in recording.events("episodes")] == ["WARN", "INFO"]


def test_purpose_and_step_are_known_without_properties_and_from_them(tmp_path):
    assert Recording(play(tmp_path / "p.rrd")).purpose == "play"
    recording = Recording(training(tmp_path / "t.rrd"))
    assert (recording.purpose, recording.step_dt) == ("training", pytest.approx(STEP_DT, rel=1e-12))
    writer = Writer(tmp_path / "r.rrd")
    writer.static("__properties/wheelleg", purpose="evaluation", step_dt=0.5, env_ids=[4], task="stand")
    writer.numbers("base/height", [1.0])
    said = Recording(writer.close())
    assert (said.purpose, said.step_dt, said.env_ids) == ("evaluation", 0.5, [4])
    assert said.properties["wheelleg"]["task"] == "stand"
    assert said.entities() == ["base/height"]


def test_a_file_that_grows_is_read_as_it_was_when_it_was_opened(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("a", [1.0])
    writer.stream.flush()
    recording = Recording(writer.path)
    writer.numbers("a", [2.0], steps=[2])
    writer.stream.flush()
    assert recording.table("a").num_rows == 1
    assert not recording.health.is_whole
    assert Recording(writer.path).table("a").num_rows == 2
    assert Recording(writer.close()).health.lines() == ["whole"]
