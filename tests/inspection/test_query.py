import numpy as np
import pytest
from inspection.synthetic import AMPLITUDE, Writer, pitch, play, training

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection.condition_query import Condition, find_hits
from wheelleg_exp.inspection.recorded_numbers import term_statistics
from wheelleg_exp.inspection.row_selection import Length, Selection, parse_iterations, parse_length
from wheelleg_exp.recording.reading.recording_reader import Recording

A, B = np.array([-1.0, 0.0, 2.0, np.nan]), np.array([1.0, 1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return Recording(play(tmp_path_factory.mktemp("play") / "r.rrd"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a", [True, False, True, False]),
        ("not a", [False, True, False, True]),
        ("a > 0", [False, False, True, False]),
        ("a != 0", [True, False, True, False]),
        ("abs(a) >= b", [True, False, True, False]),
        ("a < 0 or a > b", [True, False, True, False]),
        ("a < 0 and b", [True, False, False, False]),
        ("-1 <= a < 1", [True, True, False, False]),
        ("a * 2 + b == 5", [False, False, True, False]),
        ("not (a > 0 or b > 1)", [True, True, False, True]),
        ("b / a > 0", [False, True, True, False]),
    ],
)
def test_conditions_hold_row_by_row(text, expected):
    assert Condition(text).holds({"a": A, "b": B}).tolist() == expected


def test_names_may_have_dots_brackets_and_quotes():
    condition = Condition("actions.raw.leg[l01] > 0 and 'joints.left-hip.effort' < 1 and base.pitch")
    assert condition.names == ["actions.raw.leg[l01]", "joints.left-hip.effort", "base.pitch"]


@pytest.mark.parametrize("text", [
    "__import__('os').system('true')", "base.pitch.real.__class__()", "(lambda: 1)()", "[x for x in base]",
    "a if b else c", "a := 1", "a = 1", "a >", "", "1 > 0", "a ** 999999999", "a in b", "f'{a}'", "abs(a, b)",
    "print(a)", "a\0", "{'a': 1}", "1j > a",
    "(" * 500 + "a" + ")" * 500, "not " * 300 + "a", "a + " * 5000 + "a",
])  # fmt: skip
def test_what_is_no_condition_is_refused_and_never_run(text):
    with pytest.raises(WheellegError, match="is not a condition"):
        Condition(text)


def test_consecutive_frames_are_one_hit(recording, tmp_path):
    (hit,) = find_hits(recording, Condition("terminations.fallen"))
    assert (hit.first.step, hit.last.step, hit.frames, hit.around) == (50, 50, 1, None)
    assert hit.first.time_s == pytest.approx(1.0)
    hits = find_hits(recording, Condition(f"base.pitch > {AMPLITUDE / 2}"))
    above = np.flatnonzero(pitch() > AMPLITUDE / 2) + 1
    assert [(hit.first.step, hit.last.step) for hit in hits] == [(above[0], 41), (109, above[-1])]
    assert sum(hit.frames for hit in hits) == len(above)
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("a", np.ones(4), steps=[1, 2, 100, 101])
    hits = find_hits(Recording(writer.close()), Condition("a"))
    assert [(hit.first.step, hit.last.step) for hit in hits] == [(1, 2), (100, 101)]


def test_the_rows_around_reach_as_far_as_asked(recording):
    around = parse_length("60ms", "--around")
    (hit,) = find_hits(recording, Condition("terminations.fallen"), columns=["base.pitch"], around=around)
    table = hit.around.table
    assert table.column("step").to_pylist() == [47, 48, 49, 50, 51, 52, 53]
    np.testing.assert_array_equal(table.column("base.pitch"), pitch()[46:53])
    assert table.column_names == ["step", "sim_time", "base.pitch"]


def test_a_selection_limits_the_search_and_not_the_output(recording):
    selection = Selection(begin=Length(140, True))
    condition = Condition("terminations.fallen or terminations.time_out")
    (hit,) = find_hits(recording, condition, around=Length(20, True), selection=selection)
    assert hit.first.step == 150
    assert hit.around.table.column("step")[0].as_py() == 130


def test_every_environment_is_searched_or_the_chosen_one(tmp_path):
    recording = Recording(training(tmp_path / "r.rrd"))
    hits = find_hits(recording, Condition("terminations.fallen"))
    assert [(hit.first.env_id, hit.first.step) for hit in hits] == [(2, 50), (5, 50)]
    (hit,) = find_hits(recording, Condition("terminations.fallen"), selection=Selection(env_id=5))
    assert hit.first.env_id == 5
    (hit,) = find_hits(recording, Condition("training.Train.mean_reward == 9"))
    assert (hit.first.env_id, hit.first.iteration) == (None, 6)


def test_a_number_is_named_by_its_path_or_the_nearest_name_is_suggested(recording):
    (stats,) = term_statistics(recording, ["rewards/alive"], Selection()).values()
    assert (stats.count, stats.mean) == (200, 3.0)
    nearest = {"base.pitsh": "base.pitch", "pitch": "base.pitch", "effort": "rewards.effort"}
    for name, expected in {**nearest, "rewards/alve": "rewards.alive"}.items():
        with pytest.raises(WheellegError, match=f"did you mean '{expected}'"):
            term_statistics(recording, [name], Selection())


def test_statistics_of_a_ramp(recording, tmp_path):
    (stats,) = term_statistics(recording, ["contacts.feet.left"], Selection()).values()
    assert (stats.count, stats.mean, stats.minimum, stats.maximum) == (200, 100.5, 1.0, 200.0)
    assert stats.std == pytest.approx(np.sqrt((200**2 - 1) / 12))
    assert (stats.quantiles[0.5], stats.quantiles[0.25]) == (100.5, pytest.approx(1 + 0.25 * 199))
    assert (stats.minimum_at.step, stats.maximum_at.step) == (1, 200)
    assert stats.maximum_at.time_s == pytest.approx(4.0)
    recording = Recording(training(tmp_path / "r.rrd"))
    (stats,) = term_statistics(recording, ["base.height"], Selection()).values()
    assert (stats.count, stats.maximum_at.env_id, stats.minimum_at.env_id) == (400, 5, 2)


def test_rows_are_chosen_by_iteration_time_and_step(tmp_path):
    recording = Recording(training(tmp_path / "r.rrd"))
    name = "training.Train.mean_reward"
    chosen = term_statistics(recording, [name], Selection(iterations=parse_iterations("5-7")))[name]
    assert (chosen.count, chosen.minimum, chosen.maximum_at.iteration) == (3, 8.0, 6)
    bounds = {"end": parse_length("60steps", "--to")}, {"begin": parse_length("3.6s", "--from")}
    found = [term_statistics(recording, [name], Selection(**bound))[name].count for bound in bounds]
    assert found == [3, 2]


def test_lengths_have_units():
    lengths = {"0.5s": (0.5, False), "200ms": (0.2, False), "30 steps": (30, True), "1.5": (1.5, False)}
    for text, expected in lengths.items():
        assert parse_length(text, "--around") == Length(*expected)
