"""Pictures of the robot as data URIs, several from one recording at a time."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from wheelleg_exp.inspection.pictures import Scenery

_QUALITY = 84


def shots(shown: Scenery, times: Sequence[float], size: tuple[int, int]) -> list[str]:
    """Return pictures of moments, all from one distance, as data URIs.

    Args:
        shown: the recording's scene and motion.
        times: simulated times, s.
        size: width and height, px.

    Raises:
        WheellegError: a moment is not in the recording, or nothing can be drawn on this machine.
    """
    from wheelleg_exp.inspection.pictures import pictures, row_at

    rows = [row_at(shown, time_s=time) for time in times]
    return [_jpeg(pixels) for pixels in pictures(shown, rows, *size)]


def _jpeg(pixels: NDArray[np.uint8]) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=_QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
