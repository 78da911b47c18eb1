import numpy as np
import pytest
from inspection.synthetic import Writer
from inspection.written import DT, FELL_AT, STEPS, write_recording

from report.pages import Page
from report.runs import FIGURES, make_run
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.report import make_report
from wheelleg_exp.report.value_format import number

PICTURE = "data:image/jpeg;base64,AAAA"


@pytest.fixture
def asked(monkeypatch) -> list[list[float]]:
    moments: list[list[float]] = []

    def shots(shown, times, size):
        moments.append([round(time, 3) for time in times])
        return [PICTURE for _ in times]

    monkeypatch.setattr("wheelleg_exp.report.pictures_section.shots", shots)
    monkeypatch.setattr("wheelleg_exp.report.pictures_section.scenery", lambda recording: None)
    return moments


def add_recorded_play(run, write):
    path = run.play / f"2026-03-01_{len(list(run.play.glob('*')))}" / "recording.rrd"
    path.parent.mkdir(parents=True)
    write(path)
    run.manifest().add("play", [path], FIGURES, command=["wheelleg", "play"])


@pytest.fixture
def run(root):
    run = make_run(root)
    write_recording(run.recording, training=True)
    add_recorded_play(run, write_recording)
    return run


def test_pictures_show_an_episode_from_its_start_to_its_end(run, root, asked):
    found = Page(make_report(run.path, root).path.read_text())
    duration = FELL_AT * DT
    standing, learning = found.section("standing"), found.section("learning")
    assert f"The play, first episode: ended by fell after {duration:.2f} s 0.00 s 0.26 s 0.52 s 0.78 s" in standing
    assert f"At first, iteration 0: ended by fell after {duration:.2f} s 0.00 s" in learning
    assert "At last, iteration 10: " in learning
    times = np.linspace(DT, duration, 4).round(3).tolist()
    assert times in asked  # The first row of the recording is control step 1.
    assert len(found.all("img")) == 1 + 3 * 4
    assert all(len(image.attributes["alt"]) > 20 for image in found.all("img"))


def test_the_first_whole_episode_of_the_last_sample_is_shown_and_not_the_longest(root, asked):
    run = make_run(root)
    writer = Writer(run.recording)
    steps = np.r_[1:11, 101:201, 301:331, 501:541]
    ages = np.r_[1:11, 1:101, 1:11, 1:21, 61:101]
    iterations = (steps - 1) // 10
    writer.numbers("base/height", 0.0 * steps, steps, None, iterations)
    writer.numbers("episode/step", ages, steps, None, iterations)
    writer.numbers("terminations/fell", np.isin(steps, [10, 200, 310, 330, 540]), steps, None, iterations)
    writer.close()
    text = Page(make_report(run.path, root).path.read_text()).section("learning")
    assert "At last, iteration 30: ended by fell after 0.20 s" in text


def test_notes_of_a_recording_are_shown(root, page):
    run = make_run(root)
    writer = Writer(run.recording)
    writer.numbers("training/Train/mean_reward", [1.0], [1], None, [0])
    writer.words("log/recording", [(1, "the bound of 3 MB is reached", "WARN")])
    writer.close()
    text = page(run).section("learning")
    assert "Of the recording: the bound of 3 MB is reached." in text
    assert "No motion of this training was recorded" in text


def test_tables_contain_the_recorded_values(run, page):
    text = page(run).section("standing")
    time = DT * np.arange(1, STEPS + 1)
    error = 0.05 * np.cos(5 * time)  # the error of the forward velocity in the recording
    rms, mean = number(float(np.sqrt(np.mean(error**2)))), number(float(np.mean(error)))
    assert f"v_x {rms} m/s {mean} m/s {number(float(np.abs(error).max()))} m/s" in text
    effort = 1.5 * np.sin(4 * time)
    assert f"knee {number(float(np.sqrt(np.mean(effort**2))))} {number(float(np.abs(effort).max()))}" in text


def test_curves_and_tables_name_their_environments_and_steps(run, page, root):
    text = page(run).section("standing")
    assert f"The curves and tables are of environment 0 alone: all {STEPS} recorded steps, of 2 episodes." in text
    add_recorded_play(run, lambda path: write_recording(path, env_ids=(0, 3)))
    text = page(run).section("standing")
    assert "The curves are of environment 0, the tables of environments 0, 3: all 120 recorded steps" in text


def test_without_a_renderer_the_report_names_the_missing_package(run, root, monkeypatch):
    def nothing(*_):
        raise WheellegError("no backend draws here", expected="a driver")

    monkeypatch.setattr("wheelleg_exp.report.pictures_section.shots", nothing)
    monkeypatch.setattr("wheelleg_exp.report.pictures_section.scenery", lambda recording: None)
    made = make_report(run.path, root)
    assert made.notes == ("no pictures of the robot: no backend draws here; expected a driver",)
    assert "no pictures of the robot: no backend draws here" in Page(made.path.read_text()).section("learning")


def test_a_recording_that_was_cut_off_is_shown_as_far_as_it_goes(run, page):
    content = run.recording.read_bytes()
    run.recording.write_bytes(content[: len(content) * 3 // 4])
    text = page(run).section("learning")
    for expected in ("not whole", "inspect --repair", "Return, mean of the last 100 ended episodes"):
        assert expected in text
