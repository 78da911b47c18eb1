import json
from pathlib import Path

import pytest
from PIL import Image

from wheelleg_exp.cli.main import main
from wheelleg_exp.inspection import rerun_viewer
from wheelleg_exp.recording.reading.recording_reader import Recording

pytestmark = pytest.mark.pictures


def inspect(recording: Recording, *words: object) -> int:
    return main(["inspect", str(recording.path), *map(str, words)])


def test_a_plot_and_an_export_print_one_json_document(played, tmp_path: Path, capsys) -> None:
    words = ("--plot", tmp_path / "p.svg", "--export", "parquet", "-o", tmp_path / "out", "--json")
    assert inspect(played, *words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["plot"] == {"path": str(tmp_path / "p.svg"), "env": 0}
    assert {entry["group"] for entry in document["export"]["files"]} >= {"base", "rewards"}
    assert all(Path(entry["path"]).is_file() for entry in document["export"]["files"])


def test_chosen_terms_and_two_recordings_are_plotted(played, tmp_path: Path, several, capsys) -> None:
    assert inspect(played, "--term", "rewards.effort", "--term", "base.height", "--plot", tmp_path / "p.svg") == 0
    assert inspect(played, "--compare", several.path, "--plot", tmp_path / "q.svg") == 1  # The recordings differ.
    for name, labels in (("p", ("rewards.effort", "base.height")), ("q", (">played<", ">several, environment 0<"))):
        text = (tmp_path / f"{name}.svg").read_text()
        assert [label for label in labels if label not in text] == []


def test_a_screenshot_reports_its_time(trained, tmp_path: Path, capsys, graphics: str) -> None:
    path = tmp_path / "s.png"
    words = ("--screenshot", path, "--iteration", 5, "--at", "0.1s", "--width", 64, "--height", 48, "--json")
    assert inspect(trained, *words) == 0
    told = json.loads(capsys.readouterr().out)["screenshot"]
    assert told == {"path": str(path), "time_s": pytest.approx(126 * 0.02), "step": 126, "iteration": 5, "env": 0}
    with Image.open(path) as image:
        assert image.size == (64, 48)


def test_a_video_reports_its_length(played, tmp_path: Path, capsys, graphics: str) -> None:
    words = ("--video", tmp_path / "v.mp4", "--to", "0.2s", "--fps", 10, "--width", 64, "--height", 48)
    assert inspect(played, *words) == 0
    assert "2 pictures, 0.2 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--plot", "a.gif"), ".png, .svg or .pdf"),
        (("--export", "csv"), "-o FOLDER"),
        (("--export", "xml", "-o", "out"), "parquet or csv"),
        (("--screenshot", "a.png", "--at", "soon"), "neither a time nor a recorded term"),
        (("--screenshot", "a.png", "--width", "0"), "a picture of 0 x 720 cannot be drawn"),
        (("--video", "a.avi"), ".mp4"),
        (("--video", "a.mp4", "--from", "9s"), "no control step was recorded at the selected times"),
        (("--web", "--port", "99999"), "cannot listen on"),
    ],
)
def test_mistakes_are_one_message_and_leave_nothing(played, tmp_path, monkeypatch, capsys, words, message) -> None:
    monkeypatch.chdir(tmp_path)
    assert inspect(played, *words) == 2
    told = capsys.readouterr()
    assert (told.out, len(told.err.splitlines()), list(tmp_path.iterdir())) == ("", 1, [])
    assert message in told.err


def test_a_window_without_a_display_is_a_mistake(played, monkeypatch, capsys) -> None:
    monkeypatch.setattr(rerun_viewer, "has_display", lambda: False)
    assert inspect(played, "--open") == 2
    assert "--web" in capsys.readouterr().err
