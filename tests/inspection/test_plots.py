import xml.etree.ElementTree as ET
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from inspection.synthetic import Writer
from inspection.written import DT, FELL_AT, ITERATIONS, STEPS, numbers, scalar_values, steps_of
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from wheelleg_exp.inspection import recording_plots
from wheelleg_exp.inspection import training_curves as plots_training
from wheelleg_exp.inspection.plot_data import Source
from wheelleg_exp.inspection.plot_style import Panel, figure_bytes, figure_svg, tile
from wheelleg_exp.inspection.row_selection import Length, Selection
from wheelleg_exp.recording.reading.recording_reader import Recording

pytestmark = pytest.mark.pictures

RETURN = "Return, mean of the last 100 ended episodes"


def panel(figure: Figure, title: str) -> Axes:
    return next(axes for axes in figure.get_axes() if axes.get_title("left") == title)


def line(figure: Figure, title: str, label: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    for found in panel(figure, title).get_lines():
        if label in (None, found.get_label()) and len(found.get_xdata()) > 2:
            x, y = (np.asarray(data, dtype=float) for data in found.get_data())
            return x[np.isfinite(y)], y[np.isfinite(y)]
    raise AssertionError(f"{title} has no line '{label}'")


@pytest.mark.parametrize(
    ("title", "label", "entity"),
    [
        ("Height of the base (m)", "actual", "base/height"),
        ("Forward velocity (m/s)", "actual", "base/v_x"),
        ("Forward velocity (m/s)", "command", "commands/drive/v_x"),
        ("Pitch of the base (rad)", "actual", "base/pitch"),
    ],
)
def test_tracking_shows_what_was_recorded_and_commanded(played: Recording, title, label, entity) -> None:
    time, values = line(recording_plots.make(played, "tracking"), title, label)
    np.testing.assert_allclose(time, steps_of(training=False) * DT)
    np.testing.assert_allclose(values, numbers(steps_of(training=False))[entity])


def test_a_line_has_a_gap_where_the_robot_was_reset(played: Recording) -> None:
    drawn = panel(recording_plots.make(played, "tracking"), "Height of the base (m)").get_lines()
    values = next(np.asarray(one.get_ydata()) for one in drawn if one.get_label() == "actual")
    assert np.flatnonzero(np.isnan(values)).tolist() == [FELL_AT]
    assert len(values) == STEPS + 1


def test_a_held_joint_shows_positions_and_a_driven_one_velocities(played: Recording) -> None:
    figure = recording_plots.make(played, "joints")
    expected = numbers(steps_of(training=False))
    held, driven = "knee: position and target (rad)", "roll: velocity and target (rad/s)"
    np.testing.assert_allclose(line(figure, held, "actual")[1], expected["joints/knee/position"])
    np.testing.assert_allclose(line(figure, driven, "target")[1], expected["joints/roll/velocity_target"])
    axes = panel(figure, "knee: effort (N·m)")
    bounds = {float(one.get_ydata()[0]) for one in axes.get_lines() if len(set(one.get_ydata())) == 1}
    assert bounds == {-2.0, 2.0}
    assert axes.get_ylim()[0] < -2.0 < 2.0 < axes.get_ylim()[1]


def test_contact_forces_are_drawn_of_the_bodies_that_were_touched(played: Recording) -> None:
    figure = recording_plots.make(played, "contact_forces")
    force = line(figure, "wheel: contact force (N)")[1]
    np.testing.assert_allclose(force, 20.0 * (steps_of(training=False) % 2))
    words = [text.get_text() for text in panel(figure, "Never touched (feet)").texts]
    assert words == ["base"]


def test_reward_shares_are_the_means_of_the_weighted_terms(played: Recording) -> None:
    axes = panel(recording_plots.make(played, "reward_shares"), f"Mean reward by term over {STEPS} recorded steps")
    expected = numbers(steps_of(training=False))
    names, widths = [t.get_text() for t in axes.get_yticklabels()], [bar.get_width() for bar in axes.patches]
    shown = dict(zip(names, widths, strict=True))
    assert shown == pytest.approx({"alive": 2.0, "effort": expected["rewards/effort"].mean()})
    share = 2.0 / (2.0 - expected["rewards/effort"].mean())
    assert any(f"({share:.0%})" in text.get_text() for text in axes.texts)


def test_terms_of_a_training_are_not_labelled_per_second(trained: Recording) -> None:
    found = recording_plots.make(trained, "reward_shares").get_axes()
    titles, labels = zip(*((axes.get_title("left"), axes.get_xlabel()) for axes in found), strict=True)
    assert [title.endswith("sum of an episode / longest episode's seconds") for title in titles] == [True, True]
    assert not any("1/s" in label for label in labels)


def test_of_several_environments_the_page_names_the_one_that_it_shows(several: Recording, played: Recording) -> None:
    def words(recording: Recording, **options) -> list[str]:
        figure = recording_plots.default_page(recording, **options)
        return [part.get_suptitle() for part in figure.subfigs]

    assert "Contact forces, environment 0" in words(several)
    assert "Contact forces, environment 3" in words(several, selection=Selection(env_id=3))
    assert "Contact forces" in words(played)
    assert recording_plots.terms_figure(several, ["base.height"]).get_suptitle() == "Environment 0"
    assert recording_plots.terms_figure(played, ["base.height"]).get_suptitle() == ""


def test_terms_are_drawn_with_their_units(played: Recording, trained: Recording) -> None:
    figure = recording_plots.terms_figure(played, ["rewards.effort", "base.height", "contacts.feet"])
    titles = ["rewards.effort (1/s)", "base.height (m)", "contacts.feet: base (N)", "contacts.feet: wheel (N)"]
    assert [axes.get_title("left") for axes in figure.get_axes()] == titles
    _, values = line(recording_plots.terms_figure(played, ["rewards.effort"]), "rewards.effort (1/s)")
    np.testing.assert_allclose(values, numbers(steps_of(training=False))["rewards/effort"])
    _, values = line(recording_plots.terms_figure(trained, ["Loss.value"]), "Loss.value")
    np.testing.assert_allclose(values, scalar_values()["Loss/value"])


def test_the_largest_and_the_last_force_of_the_history_are_drawn(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("base/height", [1.0, 1.0])
    writer.numbers("contacts/feet", [[1.0, 0.0], [3.0, 0.0]], names=["l", "r"])
    writer.numbers("contacts/feet/peak", [[9.0, 0.0], [3.0, 8.0]], names=["l", "r"])
    figure = recording_plots.make(Recording(writer.close()), "contact_forces")
    curves = [(one.get_label(), one.get_ydata().tolist()) for one in panel(figure, "l: contact force (N)").get_lines()]
    assert curves == [("end of the step", [1.0, 3.0]), ("largest in the history", [9.0, 3.0])]
    assert panel(figure, "r: contact force (N)").get_ylim()[1] > 9.0


def test_terminations_are_marked_when_they_fired(played: Recording) -> None:
    axes = panel(recording_plots.make(played, "terminations"), "When terminations fired, and how often")
    assert [t.get_text() for t in axes.get_yticklabels()] == ["fell  1×", "time_out  0×"]
    np.testing.assert_allclose(axes.get_lines()[0].get_xdata(), [FELL_AT * DT])


@pytest.mark.parametrize(
    ("title", "key"),
    [(RETURN, "Train/mean_reward"), ("Value loss", "Loss/value"), ("Learning rate", "Loss/learning_rate")],
)
def test_learning_curves_are_the_recorded_scalars(trained: Recording, title, key) -> None:
    iterations, values = line(recording_plots.make(trained, "learning_curves"), title)
    np.testing.assert_array_equal(iterations, np.arange(ITERATIONS))
    np.testing.assert_allclose(values, scalar_values()[key])


def test_the_error_of_a_step_is_drawn_and_not_the_one_that_grows_with_the_episode() -> None:
    x, step, ended, grown = np.arange(5), np.full(5, 0.3), np.full(5, 0.2), np.linspace(0.03, 0.4, 5)
    drive = "drive/error_vel_xy"
    keys = (f"Metrics_per_step/{drive}", f"Episode_Metrics/{drive}_per_step", f"Metrics/{drive}")
    scalars = {key: (x, values) for key, values in zip(keys, (step, ended, grown), strict=True)}
    (axes,) = tile(plots_training.learning(scalars)).get_axes()
    assert (axes.get_title("left"), axes.get_ylabel()) == ("Planar velocity error (drive)", "m/s")
    np.testing.assert_array_equal(axes.get_lines()[0].get_ydata(), step)
    (old,) = tile(plots_training.learning({key: scalars[key] for key in keys[1:]})).get_axes()
    assert old.get_title("left") == "Mean planar velocity error (drive)"
    (older,) = tile(plots_training.learning({keys[2]: scalars[keys[2]]})).get_axes()
    assert (older.get_title("left"), older.get_ylabel()) == ("Error_vel_xy, added up over an episode (drive)", "")


def test_shares_of_endings_are_lines_because_two_may_end_an_episode() -> None:
    x, every = np.arange(5), np.ones(5)
    scalars = {f"Episode_Termination/{name}": (x, every) for name in ("a", "b")}
    (axes,) = tile(plots_training.endings(scalars)).get_axes()
    assert axes.get_title("left") == "Share of all environments whose last episode each termination ended"
    assert [one.get_label() for one in axes.get_lines()] == ["a", "b"]
    assert all((one.get_ydata() == every).all() for one in axes.get_lines())


def test_a_training_names_its_samples_and_shows_them_from_pale_to_dark(trained: Recording, played: Recording) -> None:
    assert recording_plots.PLOTS["joints"].heading(Source(trained)) == "Joints, last sample, from iteration 10 on"
    assert recording_plots.PLOTS["joints"].heading(Source(played)) == "Joints"
    samples = Source(trained).samples()
    assert [(s.first, s.last, s.iteration) for s in samples] == [(1, 60, 0), (121, 180, 5), (241, 300, 10)]
    axes = panel(recording_plots.make(trained, "tracking"), "Height of the base (m)")
    lines = [one for one in axes.get_lines() if one.get_label().startswith("iteration")]
    assert [one.get_label() for one in lines] == ["iteration 0", "iteration 5", "iteration 10"]
    lightness = [sum(mpl.colors.to_rgb(one.get_color())) for one in lines]
    assert lightness == sorted(lightness, reverse=True)
    assert all(one.get_xdata()[0] == 0.0 for one in lines)


def test_a_long_curve_is_smoothed_and_its_own_values_stay_in_sight() -> None:
    values = np.random.default_rng(0).normal(size=400)
    figure = tile(plots_training.learning({"Loss/value": (np.arange(400), values)}))
    raw, smooth = panel(figure, "Value loss").get_lines()
    np.testing.assert_array_equal(raw.get_ydata(), values)
    assert smooth.get_ydata()[200] == pytest.approx(values[195:206].mean())
    np.testing.assert_allclose(plots_training.smooth(np.array([1.0, np.nan, 3.0])), [1.0, 2.0, 3.0])


@pytest.mark.parametrize("kind", ["played", "trained", "several"])
def test_the_default_page_shows_what_matters_for_the_purpose(kind: str, request: pytest.FixtureRequest) -> None:
    recording = request.getfixturevalue(kind)
    titles = {axes.get_title("left") for axes in recording_plots.default_page(recording).get_axes()}
    assert "Height of the base (m)" in titles
    assert (RETURN in titles) == (kind == "trained")


def test_a_chosen_environment_and_span_of_time_is_what_is_drawn(several: Recording, played: Recording) -> None:
    figures = [recording_plots.make(several, "tracking", selection=Selection(env_id=i)) for i in (0, 3)]
    first, second = (line(figure, "Height of the base (m)", "actual")[1] for figure in figures)
    np.testing.assert_allclose(second - first, 0.001)
    chosen = Selection(begin=Length(0.2, False), end=Length(0.4, False))
    time, _ = line(recording_plots.make(played, "tracking", selection=chosen), "Height of the base (m)", "actual")
    np.testing.assert_allclose(time, np.arange(10, 21) * DT)


def test_an_overlay_has_a_line_a_recording(played: Recording, several: Recording, trained: Recording) -> None:
    figure = recording_plots.overlay({"one": played, "two": several}, "base.height", selection=None)
    first, second = (line(figure, "base.height (m)", label)[1] for label in ("one", "two, environment 0"))
    np.testing.assert_allclose(first, second)
    styles = {one.get_linestyle() for one in panel(figure, "base.height (m)").get_lines()}
    assert len(styles) == 2  # The lines can be distinguished in grey print.
    figure = recording_plots.overlay({"a": trained, "b": trained}, ())
    np.testing.assert_allclose(line(figure, RETURN, "b")[1], scalar_values()["Train/mean_reward"])


def test_an_svg_is_one_scalable_element_and_drawing_changes_no_setting(played: Recording) -> None:
    root = ET.fromstring(figure_svg(recording_plots.make(played, "tracking")))
    assert root.tag.endswith("svg")
    assert root.get("viewBox")
    words = {"".join(text.itertext()).strip() for text in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"Height of the base (m)", "simulated time (s)", "command"} <= words
    before = dict(mpl.rcParams)
    figure_bytes(recording_plots.make(played, "terminations"), "png")
    assert dict(mpl.rcParams) == before


@pytest.mark.parametrize(("largest", "factor"), [(3e-5, "1e−5"), (3e6, "1e6")])
def test_ticks_of_tiny_and_huge_values_are_plain_text(largest: float, factor: str) -> None:
    root = ET.fromstring(figure_svg(tile([Panel("", lambda axes: axes.plot([0.0, largest]) and None)])))
    words = ["".join(text.itertext()).strip() for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert factor in words
    assert not [word for word in words if "$" in word or "math" in word]


@pytest.mark.parametrize("kind", recording_plots.KINDS)
def test_a_figure_is_saved_by_its_ending(played: Recording, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "new" / f"figure.{kind}"
    recording_plots.save(recording_plots.make(played, "terminations"), path)
    head = path.read_bytes()[:64]
    assert {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[kind] in head
    if kind == "png":
        assert np.asarray(Image.open(path).convert("L")).std() > 5
    assert [p.name for p in path.parent.iterdir()] == [path.name]
