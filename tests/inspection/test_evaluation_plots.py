from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from wheelleg_exp.evaluation.result import Evaluation
from wheelleg_exp.inspection.evaluation_plots import draw, panels
from wheelleg_exp.inspection.plot_style import tile

pytestmark = pytest.mark.pictures

TEXTS = ("test", "cell_name", "sweep")


def table(rows: list[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name, "" if name in TEXTS else np.nan) for row in rows]) for name in names}


def axes(rows: list[Mapping[str, Any]], test: str, title: str) -> Axes:
    figure = tile(panels(table(rows))[test])
    return next(one for one in figure.get_axes() if one.get_title("left").startswith(title))


def texts(found: Axes) -> list[str]:
    return [text.get_text() for text in found.texts]


WALK = [
    {"test": "walk", "command_vx": vx, "command_wz": wz, "survived": float(vx < 0.3), "error_vx": error}
    for vx in (0.0, 0.3)
    for wz in (-0.5, 0.5)
    for error in (0.003 * (1 + (wz > 0)), 0.004 * (1 + (wz > 0)))
]


def test_a_map_of_commands_has_speed_upwards_and_a_number_a_cell():
    survived, error = axes(WALK, "walk", "Survived"), axes(WALK, "walk", "Error of the speed")
    assert texts(survived) == ["100", "100", "0", "0"]
    assert [tick.get_text() for tick in survived.get_yticklabels()] == ["0", "0.3"]
    assert [tick.get_text() for tick in survived.get_xticklabels()] == ["-0.5", "0.5"]
    assert texts(error) == ["3.5", "7.1"]  # The RMS of 3 and 4 mm/s is 3.5 mm/s.
    rows = [{"test": "walk", "command_vx": 0.1, "command_wz": 0.0, "survived": 1.0, "error_vx": 0.756}]
    assert texts(axes(rows, "walk", "Error of the speed")) == ["756"]
    rows = [{"test": "walk", "command_vx": 0.1, "command_wz": 0.0, "survived": 0.0, "error_vx": np.nan}]
    assert [panel.title for panel in panels(table(rows))["walk"]] == ["Survived (%)"]


def test_a_push_forwards_is_drawn_up_and_one_to_the_left_left():
    rows = [
        {"test": "push", "cell_name": f"{angle}° over 0 s", "limit_m_s": limit}
        for angle, limit in ((0, 0.4), (90, 0.1), (180, 0.3), (270, 0.2))
    ]
    found = axes(rows, "push", "Push")
    (line,) = [line for line in found.get_lines() if line.get_label() == "0 s"]
    expected = [(0.0, 0.4), (-0.1, 0.0), (0.0, -0.3), (0.2, 0.0), (0.0, 0.4)]
    np.testing.assert_allclose(np.transpose(line.get_data()), expected, atol=1e-12)


def test_tiles_stand_kind_by_kind_and_level_by_level():
    rows = [
        {"test": "terrain", "cell_name": f"{kind}/{2 * level + 2}mm", "level": float(level), "success": success}
        for kind, shares in (("flat", (1.0, 1.0)), ("pyramid_stairs", (1.0, 0.0)))
        for level, success in enumerate(shares)
    ]
    found = axes(rows, "terrain", "Success")
    assert texts(found) == ["100", "100", "100", "0"]
    assert [tick.get_text() for tick in found.get_yticklabels()] == ["flat", "pyramid stairs"]


def test_a_sweep_is_a_curve_next_to_the_unchanged_world():
    worlds = (("nominal", 0.0, 1.0), ("mass", 0.7, 0.0), ("mass", 0.7, 1.0), ("mass", 1.3, 1.0))
    rows = [{"test": "robust", "sweep": sweep, "value": value, "survived": share} for sweep, value, share in worlds]
    nominal, mass = axes(rows, "robust", "Survived, by mass").get_lines()
    assert set(nominal.get_ydata()) == {1.0}
    np.testing.assert_allclose(np.transpose(mass.get_data()), [(0.7, 0.5), (1.3, 1.0)])


def test_standing_falls_by_the_share_that_fell_when_it_fell():
    rows = [
        {"test": "stand", "survived": float(end == 60.0), "time_to_failure_s": end} for end in (60.0, 60.0, 10.0, 30.0)
    ]
    (line,) = axes(rows, "stand", "Episodes that still stand").get_lines()
    steps = [(0, 1), (10, 1), (10, 0.75), (30, 0.75), (30, 0.5), (60, 0.5)]
    np.testing.assert_allclose(np.transpose(line.get_data()), steps)


def test_files_are_written_once_for_each_test_and_the_same_every_time(tmp_path):
    evaluation = Evaluation({}, 0, "", {}, table(WALK), {})
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert draw(evaluation, tmp_path / name) == [tmp_path / name / "walk.png"]
    assert (tmp_path / "a" / "walk.png").read_bytes() == (tmp_path / "b" / "walk.png").read_bytes()
