"""Draw pictures of a recorded robot with MuJoCo's renderer."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.files import require_new, write_new
from wheelleg_exp.inspection import recorded_scene
from wheelleg_exp.inspection.plot_data import Sample, Source
from wheelleg_exp.inspection.recorded_scene import Camera, Motion, follow_robot, frames_of, motion_of, scene_of
from wheelleg_exp.inspection.row_selection import Length, parse_length
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.rendering.render_job import Arrow, Order, View
from wheelleg_exp.rendering.render_scene import AZIMUTH, ELEVATION, Scene
from wheelleg_exp.rendering.renderer import drawing

_KINDS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP"}
_FINER = 2  # Pictures are drawn at twice their size and then reduced (supersampling), to avoid jagged edges.
_SAMPLES = 4
_LARGEST = 4096
_SHORTEST, _LONGEST = 0.02, 1.2  # Omit arrows shorter than 0.02 robot heights; cut arrows at 1.2 robot heights.


@dataclass(frozen=True)
class Scenery:
    """A recording that is ready to draw: its source, shapes, motion, and samples."""

    source: Source
    scene: Scene
    motion: Motion
    samples: Sequence[Sample]

    @property
    def env_id(self) -> int | None:
        """The index of the drawn environment; None if only one environment was recorded."""
        return self.source.env_id if len(self.source.recording.env_ids) > 1 else None


def scenery(
    recording: Recording, env: int | None = None, at: str | None = None, iteration: int | None = None
) -> Scenery:
    """Return the scene and motion of one environment: ``env``, or where ``at`` is nonzero first, or the first one."""
    source = Source(recording, first_env(recording, at, iteration) if env is None and at is not None else env)
    scene = scene_of(source)
    motion = motion_of(source, scene)
    iteration_at_start = None if motion.iteration is None else int(motion.iteration[0])
    everything = Sample(int(motion.step[0]), int(motion.step[-1]), iteration_at_start)
    return Scenery(source, scene, motion, source.samples() or [everything])


def screenshot(
    recording: Recording,
    path: Path,
    *,
    time_s: float | None = None,
    env: int | None = None,
    width: int = 1280,
    height: int = 720,
    at: str | None = None,
    iteration: int | None = None,
    caption: bool = True,
) -> float:
    """Write a picture of the robot atomically and return the picture's simulated time, s.

    ``time_s`` counts from the start of ``iteration``, if given. ``at`` is a time such as ``1.5s`` or ``90steps``, or a
    number, such as ``terminations.base_contact``, that is nonzero there first. By default, the picture shows the middle
    of ``iteration``, or of the last recorded interval. An invalid argument raises WheellegError.
    """
    _kind(Path(path))
    shown = scenery(recording, env, at, iteration)
    row = row_at(shown, time_s=time_s, at=at, iteration=iteration)
    save(shown, row, path, width, height, caption=caption)
    return float(shown.motion.time[row])


def save(shown: Scenery, row: int, path: Path, width: int, height: int, *, caption: bool = True) -> None:
    """Write a picture of one recorded frame atomically to a file."""
    kind = _kind(Path(path))
    buffer = io.BytesIO()
    image = Image.fromarray(picture(shown, row, width, height, caption=caption))
    image.save(buffer, kind, quality=92, optimize=kind == "PNG")
    write_new(Path(path), buffer.getvalue())


def picture(shown: Scenery, row: int, width: int, height: int, *, caption: bool = True) -> NDArray[np.uint8]:
    """Return a picture (height, width, 3) of one recorded frame."""
    return pictures(shown, [row], width, height, caption=caption)[0]


def pictures(
    shown: Scenery, rows: Sequence[int], width: int, height: int, *, caption: bool = False
) -> list[NDArray[np.uint8]]:
    """Return a picture (height, width, 3) of each frame in ``rows``, with a constant camera distance."""
    require_size(width, height)
    finer = _FINER if _FINER * max(width, height) <= _LARGEST else 1
    found: list[tuple[int, Camera]] = []
    for row in rows:
        step = shown.motion.step[row]
        samples = (frames_of(shown.motion, s) for s in shown.samples if s.first <= step <= s.last)
        sample = next(samples, np.array([row]))
        camera = follow_robot(shown.scene, shown.motion, sample, width / height)
        found.append((int(np.flatnonzero(sample == row)[0]), camera))
    distance = max((camera.distance for _, camera in found), default=0.0)
    drawn = []
    with drawing(Order(shown.scene, finer * width, finer * height, _SAMPLES)) as process:
        for row, (place, camera) in zip(rows, found, strict=True):
            pixels = process.draw(view(shown, row, camera.lookat[place], distance))
            drawn.append(np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.LANCZOS)))
    if not caption:
        return drawn
    colours = recorded_scene.arrow_legend(shown.motion)
    texts = [recorded_scene.caption_lines(shown.motion, row, shown.env_id) for row in rows]
    return [recorded_scene.write_caption(p, text, colours) for p, text in zip(drawn, texts, strict=True)]


def view(shown: Scenery, row: int, lookat: NDArray[np.float64], distance: float) -> View:
    """Return the camera view of a recorded frame for MuJoCo's renderer."""
    motion, size = shown.motion, shown.scene.size
    arrows = []
    for kind in motion.arrows:
        for origin, vector in zip(kind.origins[row], kind.vectors[row], strict=True):
            length = float(np.linalg.norm(vector))
            if np.isfinite(vector).all() and length > _SHORTEST * size:
                drawn = min(length, _LONGEST * size)
                end = origin + vector * (drawn / length)
                arrows.append(Arrow(kind.rgba, min(0.016 * size, 0.12 * drawn), origin, end))
    return View(motion.pos[row], motion.quat[row], arrows, lookat, distance, AZIMUTH, ELEVATION)


def row_at(shown: Scenery, *, time_s: float | None = None, at: str | None = None, iteration: int | None = None) -> int:
    """Return the index of the recorded frame that the arguments of ``screenshot`` select."""
    times = shown.motion.time
    everything = np.arange(len(times))
    if at is not None:
        length = _length(at)
        if length is None:
            return _row_of_term(shown, at, everything if iteration is None else _of_iteration(shown, iteration))
        motion = shown.motion
        step_dt = shown.source.recording.step_dt or float(motion.time[-1]) / max(int(motion.step[-1]), 1)
        time_s = length.value * (step_dt if length.is_steps else 1.0)
    if iteration is not None:
        rows = _of_iteration(shown, iteration)
        if time_s is None:
            return int(rows[len(rows) // 2])
        return _nearest(times, frames_of(shown.motion, sample_at(shown, iteration)), time_s + float(times[rows[0]]))
    if time_s is not None:
        return _nearest(times, everything, time_s)
    rows = frames_of(shown.motion, shown.samples[-1])
    return int(rows[len(rows) // 2])


def sample_at(shown: Scenery, iteration: int) -> Sample:
    """Return the recorded interval that contains a training iteration; raise WheellegError if there is none."""
    motion = shown.motion
    if motion.iteration is not None:
        for sample in shown.samples:
            if np.any(motion.iteration[frames_of(motion, sample)] == iteration):
                return sample
    there = ", ".join(str(s.iteration) for s in shown.samples if s.iteration is not None) or "none"
    expected = f"an iteration near a recorded sample: {there}"
    raise WheellegError(f"the recording contains no row of training iteration {iteration}", expected=expected)


def _of_iteration(shown: Scenery, iteration: int) -> NDArray[np.intp]:
    sample_at(shown, iteration)
    return np.flatnonzero(shown.motion.iteration == iteration)


def first_env(recording: Recording, at: str, iteration: int | None = None) -> int | None:
    """Return the index of the environment whose recorded number ``at`` becomes nonzero first; None if it stays zero."""
    if _length(at) is not None:
        return None
    found: dict[int, int] = {}
    for env_id in recording.env_ids:
        source = Source(recording, env_id)
        entity = source.find(at)
        if entity is not None and len(steps := _steps_of_term(source, entity, iteration)):
            found[env_id] = int(steps[0])
    return min(found, key=lambda env_id: found[env_id], default=None)


def _length(words: str) -> Length | None:
    try:
        return parse_length(words, "--at")
    except WheellegError:
        return None


def require_size(width: int, height: int) -> None:
    """Raise WheellegError unless MuJoCo can draw a picture of the given width and height, px."""
    if not (16 <= width <= _LARGEST and 16 <= height <= _LARGEST):
        expected = f"16 to {_LARGEST} pixels each"
        raise WheellegError(f"a picture of {width} x {height} cannot be drawn", expected=expected)


def _kind(path: Path) -> str:
    kind = _KINDS.get(path.suffix.lower())
    if kind is None:
        raise WheellegError(f"'{path}' has no image suffix", expected="a name that ends with .png, .jpg or .webp")
    require_new(path)
    return kind


def _row_of_term(shown: Scenery, term: str, inside: NDArray[np.intp]) -> int:
    source = shown.source
    entity = source.find(term)
    if entity is None:
        names = [f"terminations.{n}" for n in source.fired()] + [f"events.{n}" for n in source.below("events")]
        expected = "a time such as 1.5s or 90steps, or one of " + ", ".join(names)
        message = f"'{term}' is neither a time nor a recorded term"
        raise WheellegError(message, expected=expected, nearest=nearest_name(term, names))
    found = inside[np.isin(shown.motion.step[inside], _steps_of_term(source, entity))]
    if not len(found):
        raise WheellegError(f"the recorded number '{term}' is always zero", expected="a term that happened")
    return int(found[0])


def _steps_of_term(source: Source, entity: str, iteration: int | None = None) -> NDArray[np.int64]:
    series = source.series(entity)
    happened = np.any(np.nan_to_num(series.values) != 0, axis=1)
    if iteration is not None and series.iteration is not None:
        happened &= series.iteration == iteration
    return series.step[happened]


def _nearest(times: NDArray[np.float64], rows: NDArray[np.intp], moment: float) -> int:
    own = times[rows]
    step = float(np.median(np.diff(own))) if len(own) > 1 else 1.0
    if not own[0] - 1.5 * step <= moment <= own[-1] + 1.5 * step:
        expected = f"a time from {own[0]:.2f} to {own[-1]:.2f} s"
        raise WheellegError(f"the recording does not contain the time {moment:g} s", expected=expected)
    return int(rows[np.argmin(np.abs(own - moment))])
