from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection import recording_plots
from wheelleg_exp.inspection.export_numbers import export
from wheelleg_exp.inspection.recorded_numbers import term_statistics
from wheelleg_exp.inspection.recording_pictures import picture, row_at, scenery, screenshot
from wheelleg_exp.inspection.recording_video import video
from wheelleg_exp.inspection.row_selection import Length, Selection, parse_iterations, parse_length

LATE = Selection(begin=Length(99.0, False))
Call = Callable[[Any, Path], Any]


def film(name: str = "a.mp4", **options: Any) -> Call:
    return lambda played, folder: video(played, folder / name, **{"width": 96, "height": 64, **options})


def shot(width: int, height: int) -> Call:
    return lambda played, _: picture(scenery(played), 0, width, height)


def row(**choice: Any) -> Call:
    return lambda played, _: row_at(scenery(played), **choice)


def parsed(parse: Callable[..., Any], *words: str) -> Call:
    return lambda *_: parse(*words)


MISTAKES: list[tuple[Call, str]] = [
    (film("a.gif"), ".mp4"),
    (film(width=97), "even"),
    (film(fps=0.0), "1 to 240"),
    (film(speed=0.0), "0.001 to 1000"),
    (film("taken.mp4"), "not overwritten"),
    (shot(0, 100), "16 to 4096"),
    (shot(100, 5000), "16 to 4096"),
    (row(time_s=9.0), "a time from 0.02 to 1.20 s"),
    (row(at="terminations.fel"), "did you mean 'terminations.fell'"),
    (row(at="terminations.time_out"), "is always zero"),
    (row(iteration=3), "no row of training iteration 3"),
    (lambda played, folder: screenshot(played, folder / "taken.png"), "not overwritten"),
    (lambda played, folder: export(played, "csv", folder / "out", terms=["rewards.efort"]), "mean 'rewards.effort'"),
    (lambda played, folder: export(played, "csv", folder / "out", selection=LATE), "is selected"),
    (lambda played, folder: export(played, "csv", folder / "taken"), "not overwritten"),
    (lambda played, folder: export(played, "csv", folder / "taken", terms=["base.height"]), "not overwritten"),
    (lambda played, _: recording_plots.default_page(played, selection=LATE), "has no data"),
    (lambda played, _: recording_plots.terms_figure(played, ["rewards.efort"]), "rewards/effort"),
    (lambda played, _: recording_plots.make(played, "trackin"), "did you mean 'tracking'"),
    (lambda played, folder: recording_plots.save(recording_plots.make(played, "terminations"), folder / "taken.svg"),
     "not overwritten"),
    (lambda *_: recording_plots.require_path(Path("figure")), ".png, .svg or .pdf"),
    (lambda played, _: term_statistics(played, ["base.pitch"], Selection(iterations=(1, 2))), "one of step, sim_time"),
    *((parsed(parse_length, text, "--around"), "0.5s") for text in ("", "s", "5 m", "1e999s", "nan", "0x10", "5 5s")),
    *((parsed(parse_iterations, text), "not a training iteration") for text in ("", "a", "5-", "-5", "1.5", "5-x")),
]  # fmt: skip


@pytest.mark.pictures
@pytest.mark.parametrize(("call", "message"), MISTAKES)
def test_a_mistake_is_reported_and_no_file_changes(played, tmp_path: Path, call: Call, message: str) -> None:
    for name in ("taken.mp4", "taken.png", "taken.svg"):
        (tmp_path / name).write_bytes(b"mine")
    (tmp_path / "taken").mkdir()
    with pytest.raises(WheellegError) as caught:
        call(played, tmp_path)
    assert message in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == {"taken", "taken.mp4", "taken.png", "taken.svg"}
    assert {path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == {b"mine"}
    assert not list((tmp_path / "taken").iterdir())
