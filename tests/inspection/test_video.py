from pathlib import Path

import av
import numpy as np
import pytest
from inspection.written import DT, STEPS

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection import recording_video as video_module
from wheelleg_exp.inspection.recording_pictures import scenery
from wheelleg_exp.inspection.recording_video import video
from wheelleg_exp.inspection.row_selection import Length, Selection
from wheelleg_exp.recording.reading.recording_reader import Recording

pytestmark = pytest.mark.pictures

SMALL = {"width": 96, "height": 64}


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_video_lasts_as_long_as_what_it_shows(played: Recording, tmp_path: Path, graphics: str) -> None:
    path, told = tmp_path / "new" / "robot.mp4", []
    done = video(played, path, fps=25.0, progress=lambda *count: told.append(count), **SMALL)
    expected = round(STEPS * DT * 25)
    assert done.frames == expected
    assert told == [(i, expected) for i in range(1, expected + 1)]
    with av.open(str(path)) as container:
        stream, codec = container.streams.video[0], container.streams.video[0].codec_context
        assert float(stream.duration * stream.time_base) == pytest.approx(STEPS * DT)
        assert (codec.width, codec.height, codec.pix_fmt, codec.name) == (96, 64, "yuv420p", "h264")
    frames = decoded(path)
    assert len(frames) == expected
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1.0
    assert [p.name for p in path.parent.iterdir()] == ["robot.mp4"]
    data = path.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat"), "the index is first, so that a browser starts at once"


@pytest.mark.parametrize(
    ("selection", "fps", "speed", "steps"),
    [
        (Selection(), 50.0, 1.0, list(range(1, 61))),
        (Selection(), 25.0, 1.0, list(range(1, 61, 2))),
        (Selection(begin=Length(0.2, False), end=Length(0.4, False)), 50.0, 1.0, list(range(10, 21))),
        (Selection(begin=Length(10, True), end=Length(20, True)), 50.0, 1.0, list(range(10, 21))),
        (Selection(end=Length(0.06, False)), 50.0, 0.5, [1, 1, 2, 2, 3, 3]),
        (Selection(), 50.0, 10.0, [1, 11, 21, 31, 41, 51]),
    ],
)
def test_a_picture_shows_the_last_recorded_frame_of_its_time(played, selection, fps, speed, steps) -> None:
    shown = scenery(played)
    takes = [video_module._resampled(shown, rows, fps, speed) for rows in video_module._takes(shown, selection)]
    assert [int(shown.motion.step[row]) for take in takes for row in take] == steps


@pytest.mark.parametrize(
    ("selection", "firsts"),
    [(Selection(), [1, 121, 241]), (Selection(iterations=(5, 5)), [121]), (Selection(iterations=(5, 11)), [121, 241])],
)
def test_a_training_is_shown_sample_by_sample(trained: Recording, selection: Selection, firsts: list[int]) -> None:
    shown = scenery(trained)
    assert [int(shown.motion.step[rows[0]]) for rows in video_module._takes(shown, selection)] == firsts


def test_an_empty_choice_is_reported_with_the_choices(trained: Recording, tmp_path: Path) -> None:
    with pytest.raises(WheellegError) as caught:
        video(trained, tmp_path / "a.mp4", selection=Selection(iterations=(3, 4)), **SMALL)
    assert "samples start at the iterations 0, 5, 10" in str(caught.value)


def test_an_interrupted_video_leaves_nothing(played: Recording, tmp_path: Path, graphics: str) -> None:
    def interrupt(done: int, _: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video(played, tmp_path / "a.mp4", progress=interrupt, **SMALL)
    assert not list(tmp_path.iterdir())
