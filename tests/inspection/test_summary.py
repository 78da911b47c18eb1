import json

import numpy as np
import pytest
import rerun as rr
from inspection.synthetic import AMPLITUDE, STEP_DT, Writer, late, play, training

from wheelleg_exp.files import dump_json
from wheelleg_exp.inspection.recording_summary import summarize
from wheelleg_exp.inspection.row_selection import Length, Selection
from wheelleg_exp.recording.reading.recording_reader import Recording


@pytest.fixture(scope="module")
def summary(tmp_path_factory):
    return summarize(Recording(play(tmp_path_factory.mktemp("play") / "r.rrd")))


def test_a_summary_names_purpose_times_parts_and_events(summary):
    assert (summary.purpose, summary.step_dt) == ("play", pytest.approx(STEP_DT, rel=1e-12))
    assert (summary.timelines["step"].first, summary.timelines["step"].last) == (1, 200)
    assert summary.timelines["sim_time"].last == pytest.approx(4.0)
    assert {part.name: (part.entities, part.rows) for part in summary.parts}["base"] == (4, 800)
    assert (summary.health.is_whole, summary.events) == (True, {"push": 2})


def test_episodes_end_where_a_termination_fired(summary):
    found = [(e.first_step, e.last_step, e.outcome, e.ended_by) for e in summary.episodes]
    assert found == [(1, 50, "failed", ("fallen",)), (51, 150, "time out", ("time_out",)), (151, 200, "unfinished", ())]
    assert [e.duration_s for e in summary.episodes] == pytest.approx([1.0, 2.0, 1.0])
    assert [e.total_reward for e in summary.episodes] == pytest.approx([2.0, 4.0, 2.0])
    figures = summary.figures
    assert (figures.count, figures.failed, figures.timed_out, figures.unfinished) == (3, 1, 1, 1)
    assert (figures.survival, figures.ended_by) == (0.5, {"fallen": 1, "time_out": 1})
    assert (figures.mean_duration_s, figures.mean_reward) == pytest.approx((1.5, 3.0))


def test_a_constant_and_an_alternating_velocity_error(summary):
    errors = {error.name: error for error in summary.tracking}
    forward, turning = errors["v_x"], errors["w_z"]
    assert (forward.rmse, forward.mean, forward.largest) == pytest.approx((0.25, 0.25, 0.25))
    assert forward.mean_command == 1.0
    assert (turning.rmse, turning.mean, turning.mean_absolute) == pytest.approx((0.5, 0.0, 0.5))


def test_the_statistics_of_a_sine(summary):
    pitch = summary.base["pitch"]
    assert pitch.mean == pytest.approx(0.0, abs=1e-15)
    assert pitch.rms == pytest.approx(AMPLITUDE / np.sqrt(2))
    assert (pitch.minimum, pitch.maximum) == pytest.approx((-AMPLITUDE, AMPLITUDE))
    assert (pitch.maximum_at.step, pitch.minimum_at.step) == (25, 75)
    assert summary.base["height"].std == pytest.approx(0.0, abs=1e-15)
    assert list(summary.base) == ["height", "pitch"]


def test_the_largest_force_and_how_long_there_was_one(summary, tmp_path):
    left, right = summary.forces
    assert (left.sensor, left.body, left.largest_n, left.at.step) == ("feet", "left", 200.0, 200)
    assert (left.mean_n, left.contact_share) == (100.5, 1.0)
    assert (right.body, right.largest_n, right.contact_share) == ("right", 0.0, 0.0)
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("contacts/feet", [[1.0, 2.0], [3.0, 4.0]], names=["l", "r"])
    writer.numbers("contacts/feet/peak", [[9.0, 2.0], [3.0, 8.0]], names=["l", "r"])
    forces = summarize(Recording(writer.close())).forces
    assert [(force.body, force.largest_n, force.at.step) for force in forces] == [("l", 9.0, 1), ("r", 8.0, 2)]


def test_efforts_at_their_limit_and_shares_of_rewards_are_summarized(summary):
    (hip,) = summary.efforts
    assert (hip.joint, hip.limit, hip.largest, hip.saturated_share) == ("hip", 2.0, 2.0, 0.25)
    assert hip.rms == pytest.approx(np.sqrt((3 * 1 + 4) / 4))
    shares = {reward.term: reward for reward in summary.rewards}
    assert list(shares) == ["effort", "alive"]
    assert (shares["alive"].share, shares["effort"].share) == (0.75, 0.25)
    assert shares["alive"].total == pytest.approx(3.0 * 4.0)
    assert (shares["effort"].mean, shares["effort"].weight) == (-1.0, -0.1)


def test_a_training_names_the_best_iteration_of_a_scalar_and_environments_together_or_one_by_one(tmp_path):
    recording = Recording(training(tmp_path / "r.rrd"))
    both, one = summarize(recording), summarize(recording, Selection(env_id=5))
    (trend,) = both.training
    assert (trend.name, trend.count, trend.first, trend.last) == ("Train/mean_reward", 10, -27.0, 0.0)
    assert (trend.highest, trend.highest_at, trend.lowest_at) == (9.0, 6, 0)
    assert (both.figures.count, one.figures.count) == (6, 3)
    assert (both.base["height"].mean, one.base["height"].mean) == pytest.approx((0.6, 1.1))
    assert (both.base["height"].maximum_at.env_id, one.env_ids) == (5, [5])


def test_figures_of_a_part_of_the_time(tmp_path):
    recording = Recording(play(tmp_path / "r.rrd"))
    part = summarize(recording, Selection(begin=Length(1.02, False), end=Length(3.0, False)))
    assert [(episode.first_step, episode.last_step) for episode in part.episodes] == [(51, 150)]
    assert part.events == {"push": 1}
    assert part.forces[0].largest_n == 150.0


def test_sample_episodes_belong_to_the_stretch_of_frames_that_they_stand_in(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    steps = np.r_[1:41, 201:241]
    iterations = (steps - 1) // 20
    fallen = np.isin(steps, [10, 210])
    writer.numbers("terminations/fallen", fallen, steps, None, iterations)
    writer.numbers("rewards/total", np.ones(80), steps, None, iterations)
    writer.words("log/episodes", [(10, "env 0: ended by fallen", "WARN"), (210, "env 0: ended by fallen", "WARN")])
    samples = summarize(Recording(writer.close())).samples
    found = [(s.iteration, s.last_iteration, s.episodes, s.cut, s.survival) for s in samples]
    assert found == [(0, 1, 1, 1, 0.0), (10, 11, 1, 1, 0.0)]


def test_environments_of_one_sample_begin_each_with_its_own_episode(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    writer.stream.send_property("wheelleg", rr.AnyValues(env_ids=[0, 3], max_episode_length=40))
    for branch, wait in (("env_0", 0), ("env_3", 30)):
        steps = np.r_[1:21, 201:221] + wait
        writer.numbers(f"{branch}/terminations/fallen", np.isin(steps - wait, [20, 220]), steps, None, steps // 20)
    samples = summarize(Recording(writer.close())).samples
    assert [(s.first_step, s.last_step, s.episodes, s.cut) for s in samples] == [(1, 50, 2, 0), (201, 250, 2, 0)]


def test_figures_of_a_training_are_of_the_last_sample_with_a_whole_episode(tmp_path):
    recording = Recording(late(tmp_path / "r.rrd"))
    summary = summarize(recording)
    assert (summary.sample.iteration, summary.sample.first_step, summary.sample.last_step) == (10, 201, 240)
    assert (summary.figures.survival, summary.figures.mean_reward) == (1.0, pytest.approx(40 * STEP_DT))
    assert (summary.base["height"].mean, summary.frames) == (2.0, (40, 70))
    assert [sample.survival for sample in summary.samples] == [0.0, 1.0, None]
    assert len(summary.episodes) == 3
    early = summarize(recording, Selection(iterations=(0, 5)))
    assert (early.sample, early.figures.survival, early.base["height"].mean) == (None, 0.0, 1.0)


def test_an_episode_that_two_terminations_end_counts_once(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    rows = np.arange(1, 31)
    writer.numbers("terminations/a", np.isin(rows, [10, 20]))
    writer.numbers("terminations/b", np.isin(rows, [20, 30]))
    figures = summarize(Recording(writer.close())).figures
    assert figures.ended_by == {"a": 1, "a and b": 1, "b": 1}
    assert sum(figures.ended_by.values()) == figures.whole == 3


def test_samples_and_the_whole_are_figures_of_the_same_episodes(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    steps = np.arange(101, 161)
    ends = np.isin(steps, [110, 130])
    writer.numbers("terminations/fallen", ends, steps, None, np.zeros(60))
    writer.numbers("rewards/total", np.where(ends, -100.0, 1.0), steps, None, np.zeros(60))
    writer.numbers("episode/number", np.cumsum(np.r_[0, ends[:-1]]), steps)
    writer.numbers("episode/step", np.r_[31:41, 1:21, 1:31], steps)
    writer.numbers("episode/terminated", ends, steps)
    writer.numbers("episode/truncated", 0 * steps, steps)
    summary = summarize(Recording(writer.close()))
    (sample,) = summary.samples
    assert (sample.episodes, sample.cut, sample.survival) == (1, 2, 0.0)
    figures = summary.figures
    assert (figures.count, figures.whole, figures.begun_before, figures.unfinished) == (3, 1, 1, 1)
    assert sample.mean_reward == figures.mean_reward == pytest.approx((19 - 100) * STEP_DT)
    assert sample.mean_duration_s == figures.mean_duration_s == figures.longest_s == pytest.approx(20 * STEP_DT)
    writer = Writer(tmp_path / "unfinished.rrd")
    writer.numbers("terminations/fallen", [0, 0], None, None, [0, 0])
    writer.numbers("rewards/total", [1.0, 1.0], None, None, [0, 0])
    (sample,) = summarize(Recording(writer.close())).samples
    assert (sample.survival, sample.mean_duration_s, sample.mean_reward) == (None, None, None)


def test_episodes_are_separated_by_their_marks_if_present(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("terminations/a", [0, 0, 1, 1])
    writer.numbers("terminations/b", [0, 0, 0, 1])
    writer.numbers("episode/number", [4, 4, 4, 5])
    writer.numbers("episode/step", [31, 32, 33, 1])
    writer.numbers("episode/terminated", [0, 0, 0, 1])
    writer.numbers("episode/truncated", [0, 0, 1, 0])
    first, second = summarize(Recording(writer.close())).episodes
    assert (first.outcome, first.ended_by, first.is_from_start) == ("time out", ("a",), False)
    assert first.duration_s == pytest.approx(33 * STEP_DT)
    assert (second.outcome, second.ended_by, second.is_from_start) == ("failed", ("a", "b"), True)


def test_nan_and_inf_are_counted_and_left_out_and_a_joint_may_have_any_name(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("base/pitch", [1.0, np.nan, 3.0, np.inf])
    writer.numbers("rewards/a", [np.nan, np.nan, 2.0, 4.0])
    writer.numbers(r"joints/left\ hip\.x/effort", [1.0, 2.0])
    writer.static(r"joints/left\ hip\.x", effort_limit=[2.0])
    summary = summarize(Recording(writer.close()))
    pitch = summary.base["pitch"]
    assert (pitch.count, pitch.nan, pitch.infinite, pitch.mean, pitch.maximum) == (4, 1, 1, 2.0, 3.0)
    assert summary.rewards[0].mean == 3.0
    (use,) = summary.efforts
    assert (use.joint, use.saturated_share) == ("left hip.x", 0.5)


def test_a_summary_can_be_written_as_json(summary):
    document = json.loads(dump_json(summary.as_dict()))
    assert document["figures"]["survival"] == 0.5
    assert document["base"]["pitch"]["quantiles"]["0.5"] == pytest.approx(0.0, abs=1e-15)
