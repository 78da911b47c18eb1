"""Films made while training: what they show, that they change nothing, and what becomes of them later."""

from __future__ import annotations

import shutil
from pathlib import Path

import av
import numpy as np
import pytest
from av.error import FFmpegError
from patience import thinned

from jobs.small import SMALL, only_run, succeed, wheelleg
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import sha256
from wheelleg_exp.jobs.train.training_recording import films_from
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.rendering import live_pictures, renderer, video_file
from wheelleg_exp.rendering.live_pictures import LivePictures
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = [pytest.mark.train, pytest.mark.pictures]
FILMED = [*SMALL, "recording.video_every=2"]  # A film has 30 steps of 1/60 s.


def shape(path: Path) -> tuple[int, int, int, float]:
    """Return how many pictures a film has, their height and width, and their rate, 1/s."""
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate)
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50, "nothing moves"
    return len(pictures), *pictures[0].shape[:2], rate


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> tuple[Path, list[np.ndarray]]:
    """Return a filmed training and the drawn positions; the check of the graphics draws the first one."""
    root, drawn = tmp_path_factory.mktemp("filmed"), []
    draw = LivePictures.draw
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_pictures, "_SAMPLES", 0)
        patch.setattr(LivePictures, "draw", lambda self, qpos: (drawn.append(qpos), draw(self, qpos))[1])
        said = wheelleg("train", *FILMED, f"run.root={root}")
    if "drawing is not possible" in said.err:
        pytest.skip(said.err)
    assert said.status == 0, said.err
    return only_run(root), drawn


def test_every_second_iteration_begins_a_film(filmed):
    videos = filmed[0] / "videos"
    assert sorted(path.name for path in videos.iterdir()) == ["iteration_0.mp4", "iteration_2.mp4"]
    assert shape(videos / "iteration_0.mp4") == (15, 360, 640, 30)  # A picture shows every second step.
    assert shape(videos / "iteration_2.mp4") == (12, 360, 640, 30)  # The training ends after 24 steps.


def test_the_film_shows_the_recorded_states(filmed):
    path, drawn = filmed
    recording = Recording(path / "recording.rrd")
    rows, steps = recording.values("state/qpos"), recording.table("state/qpos")["step"].to_numpy()
    there = {step: row for step, row in zip(steps, rows, strict=True) if step <= 29}
    assert len(there) > 20
    for step, row in there.items():
        if step % 2 == 1:  # Pictures show the steps 1, 3, ..., 29.
            np.testing.assert_array_equal(drawn[1 + step // 2], row)


def test_a_film_changes_no_number_and_is_in_the_manifest(filmed, trained):
    path = filmed[0]
    for name in ("model_0.pt", "model_1.pt", "model_2.pt"):
        assert sha256(path / name) == sha256(trained.run.path / name), name
    files = RunDirectory.open(path, path.parents[1]).manifest().data["files"]
    for name in ("videos/iteration_0.mp4", "videos/iteration_2.mp4"):
        assert files[name]["sha256"] == sha256(path / name)
    succeed("verify", path)


def test_a_resume_leaves_earlier_films_and_repeats_those_past_its_checkpoint(filmed, tmp_path, monkeypatch):
    monkeypatch.setattr(live_pictures, "_SAMPLES", 0)
    path = tmp_path / "runs" / "stand" / filmed[0].name
    shutil.copytree(filmed[0], path)
    (path / "model_2.pt").unlink()
    kept, later = (path / "videos" / f"iteration_{n}.mp4" for n in (0, 2))
    before, digest = kept.stat().st_mtime_ns, sha256(later)
    later.write_bytes(b"of a training that was not")
    (path / "videos" / ".iteration_2.mp4.tmp").write_bytes(b"half")
    succeed("resume", path)
    assert (kept.stat().st_mtime_ns, sha256(later), len(list((path / "videos").iterdir()))) == (before, digest, 2)
    assert wheelleg("verify", path).status == 0


def test_a_machine_that_cannot_draw_is_reported_before_a_run_exists(tmp_path, monkeypatch):
    monkeypatch.setattr(renderer, "backends", lambda: ("none",))
    said = wheelleg("train", *FILMED, f"run.root={tmp_path / 'runs'}")
    assert (said.status, said.err.count("recording.video_every: drawing is not possible on this machine")) == (2, 1)
    assert "expected 0 for no films, or a driver" in " ".join(said.err.split())
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "error", thinned([FFmpegError(1, "the driver gave up"), SimulationFailure("the driver gave up")], 2)
)
def test_a_film_that_fails_ends_the_filming_and_not_the_training(tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(video_file, "write", fail)
    short = ["agent.max_iterations=2", "recording.steps=6", "recording.video_every=1"]
    said = succeed("train", *SMALL, *short, f"run.root={tmp_path / 'runs'}")
    assert said.err.count("no film from iteration 0 on") == said.err.count("no film from") == 1
    assert "the driver gave up" in said.err
    assert (only_run(tmp_path / "runs") / "model_1.pt").is_file()


def test_films_are_chosen_by_number_and_others_files_stay(tmp_path):
    for name in ("iteration_9.mp4", "iteration_10.mp4", "mine.mp4"):
        (tmp_path / name).touch()
    assert [path.name for path in films_from(tmp_path, 10)] == ["iteration_10.mp4"]
