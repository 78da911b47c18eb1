import json

import pytest
from inspection.synthetic import play

from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.inspection.recording_target import find_target, recordings_of
from wheelleg_exp.run.manifest import FORMAT
from wheelleg_exp.run.run_directory import RunDirectory


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "stand" / "2026-01-02_03-04-05_0"
    for name in (".", "play/2026-01-03_00-00-00", "play/2026-01-04_00-00-00"):
        (folder / name).mkdir(parents=True, exist_ok=True)
        play(folder / name / "recording.rrd")
    manifest = {"format": FORMAT, "status": "finished", "task": "stand", "started": "2026-01-02T03:04:05+00:00"}
    manifest |= {"ended": None, "results": {}, "resumes": [], "additions": [], "files": {}}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return RunDirectory(folder)


@pytest.mark.parametrize("word", ["latest", "2026-01-02_03-04-05_0", "stand/2026-01-02_03-04-05_0"])
def test_a_run_stands_for_the_recording_of_its_training(run, word):
    target = find_target(word, "runs")
    assert (target.path, target.run) == (run.recording, run)
    assert [path.parent.name for path in target.others()] == ["2026-01-03_00-00-00", "2026-01-04_00-00-00"]


def test_the_newest_play_or_any_other(run):
    assert find_target("latest", "runs", play=True).path.parent.name == "2026-01-04_00-00-00"
    older = run.play / "2026-01-03_00-00-00"
    for word in (older, older / "recording.rrd"):
        target = find_target(word, "runs")
        assert (target.path, target.run) == (older / "recording.rrd", run)
    assert recordings_of(run)[0] == run.recording


def test_a_file_belongs_to_no_run_and_a_folder_stands_for_its_only_recording(tmp_path):
    target = find_target(play(tmp_path / "any.rrd"), "runs")
    assert (target.path, target.run, target.others()) == (tmp_path / "any.rrd", None, [])
    with pytest.raises(WheellegError, match=r"--play: .* is not a run"):
        find_target(tmp_path / "any.rrd", "runs", play=True)
    assert find_target(tmp_path, "runs").path == tmp_path / "any.rrd"
    play(tmp_path / "two.rrd")
    with pytest.raises(RunDirectoryError, match=r"contains 2 recordings; expected one of any\.rrd, two\.rrd"):
        find_target(tmp_path, "runs")


def test_an_unrecorded_run_is_reported_with_its_plays(run):
    run.recording.unlink()
    run.hydra.mkdir()
    (run.hydra / "config.yaml").write_text("recording: {enabled: false}")
    with pytest.raises(RunDirectoryError, match=r"recording.enabled=false; its plays were recorded: play/2026-01-03"):
        find_target("latest", "runs")
    (run.hydra / "config.yaml").write_text("recording: [broken")
    with pytest.raises(RunDirectoryError, match=r"there is no recording\.rrd"):
        find_target("latest", "runs")
    for path in run.play.glob("*/recording.rrd"):
        path.unlink()
    with pytest.raises(RunDirectoryError, match=r"has no recording by 'wheelleg play'.*wheelleg play"):
        find_target("latest", "runs", play=True)


def test_unknown_words_are_reported_with_the_nearest(run, tmp_path):
    play(tmp_path / "walk.rrd")
    with pytest.raises(RunDirectoryError, match=r"there is no file 'wolk\.rrd'.*did you mean 'walk\.rrd'"):
        find_target("wolk.rrd", "runs")
    with pytest.raises(RunDirectoryError, match=r"there is no run 'latets'.*did you mean 'latest'"):
        find_target("latets", "runs")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunDirectoryError, match="'empty' is not a run, and contains no recordings"):
        find_target("empty", "runs")
