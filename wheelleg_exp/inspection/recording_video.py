"""Draw videos of a recorded robot with MuJoCo's renderer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import require_new
from wheelleg_exp.inspection import recorded_scene
from wheelleg_exp.inspection.plot_data import chosen_rows
from wheelleg_exp.inspection.recorded_scene import follow_robot, frames_of
from wheelleg_exp.inspection.recording_pictures import Scenery, require_size, scenery, view
from wheelleg_exp.inspection.row_selection import Selection
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.rendering import video_file
from wheelleg_exp.rendering.render_job import Order
from wheelleg_exp.rendering.renderer import drawing

_SAMPLES = 4
_MOST_PICTURES = 200_000


@dataclass(frozen=True)
class Video:
    """A written video: frames, frames per second, the codec's name, and the environment if there are several."""

    frames: int
    fps: float
    codec: str
    env_id: int | None = None

    @property
    def duration(self) -> float:
        """The playing time of the video, s."""
        return self.frames / self.fps


def video(
    recording: Recording,
    path: Path,
    *,
    selection: Selection | None = None,
    fps: float = 30.0,
    speed: float = 1.0,
    width: int = 960,
    height: int = 540,
    caption: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Video:
    """Write a video of the recorded robot atomically to a file: H.264 in an .mp4 file, which browsers can play.

    By default, it shows the first environment: a few samples of a training in sequence, or all frames of a play or
    evaluation. ``speed`` is simulated seconds per second. ``width`` and ``height`` are even numbers of pixels.
    ``progress`` gets the numbers of finished and of all frames. An invalid argument raises WheellegError.
    """
    path = Path(path)
    if path.suffix.lower() not in video_file.KINDS:
        expected = "a name that ends with " + ", ".join(video_file.KINDS)
        raise WheellegError(f"'{path}' has no supported video suffix", expected=expected)
    require_new(path)
    require_size(width, height)
    if width % 2 or height % 2:
        raise WheellegError(f"a video of {width} x {height} px cannot be encoded", expected="even numbers of pixels")
    if not (1 <= fps <= 240):
        raise WheellegError(f"a video cannot have {fps:g} frames per second", key="--fps", expected="1 to 240")
    if not (1e-3 <= speed <= 1e3):
        raise WheellegError(f"the playback speed cannot be {speed:g}", key="--speed", expected="0.001 to 1000")
    chosen = selection or Selection()
    shown = scenery(recording, chosen.env_id)
    takes = [_resampled(shown, rows, fps, speed) for rows in _takes(shown, chosen)]
    pictures, total = _pictures(shown, takes, width, height, caption), sum(map(len, takes))
    report = None if progress is None else lambda done: progress(done, total)
    return Video(total, fps, video_file.write(path, pictures, fps, (width, height), report), shown.env_id)


def _takes(shown: Scenery, selection: Selection) -> list[NDArray[np.intp]]:
    motion = shown.motion
    is_whole = selection.begin is None and selection.end is None and selection.iterations is None
    samples = shown.source.shown_samples() if is_whole and shown.source.is_training else shown.samples
    chosen = chosen_rows(selection, motion.step, motion.time, motion.iteration)
    found = [rows for s in samples if len(rows := np.intersect1d(frames_of(motion, s), chosen))]
    if not found:
        known = [str(sample.iteration) for sample in shown.samples if sample.iteration is not None]
        iterations = f"; samples start at the iterations {', '.join(known)}" if known else ""
        expected = f"times from {motion.time[0]:.2f} to {motion.time[-1]:.2f} s{iterations}"
        raise WheellegError("no control step was recorded at the selected times", expected=expected)
    return found


def _resampled(shown: Scenery, rows: NDArray[np.intp], fps: float, speed: float) -> NDArray[np.intp]:
    """Return the index of the recorded frame for each video frame: the last frame until the video frame's time."""
    time = np.nan_to_num(shown.motion.time[rows])
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else speed / fps
    count = max(1, round((time[-1] - time[0] + spacing) * fps / speed))
    if count > _MOST_PICTURES:
        expected = f"at most {_MOST_PICTURES}: --from, --to, --speed"
        raise WheellegError(f"the video would have too many frames: {count}", expected=expected)
    moments = time[0] + np.arange(count) * speed / fps
    # Add 1e-9 s to the time of each video frame, because recorded simulation times have rounding errors.
    return np.asarray(rows[np.clip(np.searchsorted(time, moments + 1e-9, side="right") - 1, 0, len(rows) - 1)])


def _pictures(
    shown: Scenery, takes: Sequence[NDArray[np.intp]], width: int, height: int, caption: bool
) -> Iterator[NDArray[np.uint8]]:
    cameras = [follow_robot(shown.scene, shown.motion, rows, width / height) for rows in takes]
    distance = max(camera.distance for camera in cameras)
    colours = recorded_scene.arrow_legend(shown.motion)
    with drawing(Order(shown.scene, width, height, _SAMPLES)) as process:
        for rows, camera in zip(takes, cameras, strict=True):
            for row, lookat in zip(rows.tolist(), camera.lookat, strict=True):
                pixels = process.draw(view(shown, row, lookat, distance))
                texts = recorded_scene.caption_lines(shown.motion, row, shown.env_id)
                yield recorded_scene.write_caption(pixels, texts, colours) if caption else pixels
