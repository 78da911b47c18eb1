"""Encode pictures as a video file in H.264, a format that browsers can play."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import for_people, require_new

if TYPE_CHECKING:
    from av import VideoStream
    from av.container import OutputContainer

KINDS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
_CODECS = ("libx264", "h264", "libopenh264", "mpeg4")
_QUALITY = {"crf": "20", "preset": "medium"}


def write(
    path: Path,
    pictures: Iterable[NDArray[np.uint8]],
    fps: float,
    size: tuple[int, int],
    progress: Callable[[int], None] | None = None,
) -> str:
    """Write pictures (height, width, 3) as a video file, atomically, and return the name of the codec.

    ``path`` (.mp4, .mkv or .mov) must not exist. ``size`` is width and height, px, both even; ``progress`` gets the
    number of written pictures. Raise WheellegError if the file cannot be written or PyAV has no suitable encoder.
    """
    import av

    kind = KINDS[path.suffix.lower()]
    aside = path.with_name(f".{path.name}.tmp")
    try:
        with for_people(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            # Write an MP4 file's index at the front, so that a browser can start playing before the download ends.
            options = {"movflags": "+faststart"} if kind in ("mp4", "mov") else {}
            with av.open(str(aside), "w", format=kind, options=options) as container:
                stream, codec = _stream(container, fps, size)
                for done, pixels in enumerate(pictures, start=1):
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), "rgb24")))
                    if progress is not None:
                        progress(done)
                container.mux(stream.encode())
            require_new(path)
            aside.replace(path)
    finally:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
    return codec


def _stream(container: OutputContainer, fps: float, size: tuple[int, int]) -> tuple[VideoStream, str]:
    """Return a stream of H.264 video, or of MPEG-4 video if PyAV has no H.264 encoder, and the name of the codec."""
    import av

    for codec in _CODECS:
        if codec not in av.codecs_available:
            continue
        try:
            stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
        except (ValueError, av.FFmpegError):  # `av.codecs_available` also lists codecs without an encoder.
            continue
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.options = dict(_QUALITY) if codec == "libx264" else {}
        return stream, codec
    message = "PyAV has neither an H.264 nor an MPEG-4 encoder"
    raise WheellegError(message, expected="PyAV from its wheels: pip install av")
