"""Videos of the robot, drawn with MuJoCo from what was recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import for_people, require_new
from wheelleg_exp.inspection.pictures import captions
from wheelleg_exp.inspection.pictures.camera import follow
from wheelleg_exp.inspection.pictures.pictures import Scenery, require_size, scenery, view
from wheelleg_exp.inspection.pictures.recorded_scene import frames_of
from wheelleg_exp.inspection.pictures.render_job import Order
from wheelleg_exp.inspection.pictures.renderer import Drawing, drawing
from wheelleg_exp.inspection.plots.plot_data import chosen_rows
from wheelleg_exp.inspection.questions.selection import Selection
from wheelleg_exp.recording.reading.reader import Recording

KINDS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
_CODECS = ("libx264", "h264", "libopenh264", "mpeg4")
_SAMPLES = 4
_MOST_PICTURES = 200_000
_QUALITY = {"crf": "20", "preset": "medium"}

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Video:
    """What was written: frames, their rate, 1/s, the codec's name, and which of several recorded environments."""

    frames: int
    fps: float
    codec: str
    env_id: int | None = None

    @property
    def duration(self) -> float:
        """How long it plays, s."""
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
    progress: Progress | None = None,
) -> Video:
    """Write a video of the robot (H.264 in an .mp4, as browsers play it); whole or not at all.

    Args:
        recording: what it is drawn from.
        path: the file: .mp4, .mkv or .mov; it must not be there yet.
        selection: which environment, by default the first, and which rows; by default a few samples of a training,
            one after the other, and the whole of anything else.
        fps: pictures a second.
        speed: simulated seconds a second: 0.25 is slow motion.
        width: px, even.
        height: px, even.
        caption: whether time, command and the meaning of arrows are written into it.
        progress: called with the frames so far and in all.

    Raises:
        WheellegError: something of this is wrong, or nothing can be drawn on this machine.
    """
    path = Path(path)
    kind = _checked(path, fps, speed, width, height)
    chosen = Selection() if selection is None else selection
    shown = scenery(recording, chosen.env_id)
    takes = [_resampled(shown, rows, fps, speed) for rows in _takes(shown, chosen)]
    pictures = _pictures(shown, takes, width, height, caption)
    total = sum(map(len, takes))
    codec = _encode(path, kind, pictures, total, fps, (width, height), progress)
    return Video(total, fps, codec, shown.env_id)


def _checked(path: Path, fps: float, speed: float, width: int, height: int) -> str:
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        raise WheellegError(f"'{path}' says no kind of video", expected="a name that ends with " + ", ".join(KINDS))
    require_new(path)
    require_size(width, height)
    if width % 2 or height % 2:
        raise WheellegError(f"a video of {width} x {height} cannot be encoded", expected="even numbers of pixels")
    if not (1 <= fps <= 240):
        raise WheellegError(f"{fps:g} pictures a second", key="--fps", expected="1 to 240")
    if not (1e-3 <= speed <= 1e3):
        raise WheellegError(f"a speed of {speed:g}", key="--speed", expected="0.001 to 1000")
    return kind


def _takes(shown: Scenery, selection: Selection) -> list[NDArray[np.intp]]:
    """Return the frames of each uninterrupted piece."""
    motion = shown.motion
    is_whole = selection.begin is None and selection.end is None and selection.iterations is None
    samples = shown.source.shown_samples() if is_whole and shown.source.is_training else shown.samples
    chosen = chosen_rows(selection, motion.step, motion.time, motion.iteration)
    found = [rows for s in samples if len(rows := np.intersect1d(frames_of(motion, s), chosen))]
    if not found:
        raise WheellegError(
            "nothing that is chosen was recorded",
            expected=f"times from {motion.time[0]:.2f} to {motion.time[-1]:.2f} s" + _iterations(shown),
        )
    return found


def _iterations(shown: Scenery) -> str:
    known = [str(sample.iteration) for sample in shown.samples if sample.iteration is not None]
    return f"; samples begin at the iterations {', '.join(known)}" if known else ""


def _resampled(shown: Scenery, rows: NDArray[np.intp], fps: float, speed: float) -> NDArray[np.intp]:
    """Return the frame that is shown in each picture: the last recorded one at its time."""
    time = np.nan_to_num(shown.motion.time[rows])
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else speed / fps
    count = max(1, round((time[-1] - time[0] + spacing) * fps / speed))
    if count > _MOST_PICTURES:
        raise WheellegError(
            f"it would have {count} pictures", expected=f"at most {_MOST_PICTURES}: --from, --to, --speed"
        )
    moments = time[0] + np.arange(count) * speed / fps
    places = np.searchsorted(time, moments + 1e-9, side="right") - 1
    return np.asarray(rows[np.clip(places, 0, len(rows) - 1)])


def _pictures(
    shown: Scenery, takes: Sequence[NDArray[np.intp]], width: int, height: int, caption: bool
) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures; the camera keeps one distance throughout."""
    cameras = [follow(shown.scene, shown.motion, rows, width / height) for rows in takes]
    distance = max(camera.distance for camera in cameras)
    colours = captions.legend(shown.motion)
    with drawing(Order(shown.scene, width, height, _SAMPLES)) as process:
        for rows, camera in zip(takes, cameras, strict=True):
            for row, lookat in zip(rows.tolist(), camera.lookat, strict=True):
                yield _picture(shown, process, row, lookat, distance, colours if caption else None)


def _picture(shown: Scenery, process: Drawing, row: int, lookat: Any, distance: float, colours: Any) -> Any:
    pixels = process.draw(view(shown, row, lookat, distance))
    return (
        pixels if colours is None else captions.write(pixels, captions.lines(shown.motion, row, shown.env_id), colours)
    )


def _encode(
    path: Path,
    kind: str,
    pictures: Iterator[NDArray[np.uint8]],
    total: int,
    fps: float,
    size: tuple[int, int],
    progress: Progress | None,
) -> str:
    """Write pictures beside the file and move them to its place; return the codec's name."""
    import av

    aside = path.with_name(f".{path.name}.tmp")
    try:
        with for_people(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with av.open(str(aside), "w", format=kind, options=_options(kind)) as container:
                stream, codec = _stream(container, fps, size)
                for done, pixels in enumerate(pictures, start=1):
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), "rgb24")))
                    if progress is not None:
                        progress(done, total)
                container.mux(stream.encode())
            require_new(path)
            aside.replace(path)
    finally:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
    return codec


def _options(kind: str) -> dict[str, str]:
    """Return the container's options: the index at the front, so that a browser starts before it has read all."""
    return {"movflags": "+faststart"} if kind in ("mp4", "mov") else {}


def _stream(container: Any, fps: float, size: tuple[int, int]) -> tuple[Any, str]:
    """Return an encoder and its name: H.264 where this PyAV brings one, else what every player knows."""
    import av

    for codec in _CODECS:
        if codec not in av.codecs_available:
            continue
        try:
            stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
        except (ValueError, av.FFmpegError):  # the name is a decoder's
            continue
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.options = dict(_QUALITY) if codec == "libx264" else {}
        return stream, codec
    raise WheellegError("PyAV has no encoder for videos", expected="PyAV from its wheels: pip install av")
