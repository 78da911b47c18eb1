import numpy as np
import pytest
from inspection.synthetic import Writer, drive, pitch, play, training

from wheelleg_exp.inspection.compare_recordings import compare
from wheelleg_exp.recording.reading.recording_reader import Recording


def written(path, **changed):
    writer = Writer(path, recording_id=path.stem)
    for name, values in {"pitch": pitch(), "height": np.full(200, 0.1), **changed}.items():
        writer.numbers(f"base/{name}", values)
    return Recording(writer.close())


def test_recordings_of_the_same_are_equal_whatever_their_ids_and_even_if_one_was_killed(tmp_path):
    one, two = (Recording(play(tmp_path / f"{i}.rrd", recording_id=str(i))) for i in range(2))
    found = compare(one, two)
    assert found.is_equal
    assert len(found.equal) == len(one.entities())
    assert found.numbers == []
    writer = Writer(tmp_path / "k.rrd")
    drive(writer)
    assert compare(Recording(play(tmp_path / "r.rrd")), Recording(writer.kill())).is_equal


def test_the_last_bit_of_one_number_is_found_where_it_first_differs(tmp_path):
    other = pitch()
    other[120] = np.nextafter(other[120], 1.0)
    other[150] += 0.5
    found = compare(written(tmp_path / "a.rrd"), written(tmp_path / "b.rrd", pitch=other))
    assert not found.is_equal
    assert (found.different, found.equal) == (["base/pitch"], ["base/height"])
    (number,) = found.numbers
    assert number.name == "base.pitch"
    assert (number.parting.step, number.parting.time_s) == (121, pytest.approx(2.42))
    assert (number.parting.first, number.parting.second) == (pitch()[120], other[120])
    assert number.largest == pytest.approx(0.5)
    assert number.second.mean - number.first.mean == pytest.approx(0.5 / 200)


def test_what_parts_first_stands_first(tmp_path):
    early, late = np.full(200, 0.1), pitch()
    early[10], late[100] = 0.2, 1.0
    found = compare(written(tmp_path / "a.rrd"), written(tmp_path / "b.rrd", pitch=late, height=early))
    parted = [(number.name, number.parting.step) for number in found.numbers]
    assert parted == [("base.height", 11), ("base.pitch", 101)]


def test_a_recording_that_stopped_earlier_differs_only_in_its_rows(tmp_path):
    found = compare(written(tmp_path / "a.rrd"), written(tmp_path / "b.rrd", pitch=pitch()[:150]))
    (number,) = found.numbers
    assert (number.parting.step, number.rows, number.largest) == (None, (200, 150), None)
    found = compare(written(tmp_path / "a.rrd", more=[1.0]), written(tmp_path / "b.rrd", other=[1.0]))
    assert (found.only_first, found.only_second) == (["base/more"], ["base/other"])
    assert not found.is_equal


def test_nan_equals_nan_and_the_sign_of_zero_differs(tmp_path):
    values = np.where(np.arange(200) == 3, np.nan, 0.0)
    assert compare(written(tmp_path / "a.rrd", pitch=values), written(tmp_path / "b.rrd", pitch=values)).is_equal
    signed = values.copy()
    signed[7] = -0.0
    (number,) = compare(written(tmp_path / "c.rrd", pitch=values), written(tmp_path / "d.rrd", pitch=signed)).numbers
    assert (number.parting.step, number.largest) == (8, 0.0)


def test_environments_are_compared_one_by_one(tmp_path):
    one, two = (Recording(training(tmp_path / f"{i}.rrd", {2: 0.0, 5: i})) for i in range(2))
    (number,) = compare(one, two).numbers
    assert (number.name, number.largest) == ("env_5.base.height", 1.0)
