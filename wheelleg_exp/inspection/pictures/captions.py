"""What is written into pictures of the robot: when it is, what it was told, what the arrows mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wheelleg_exp.inspection.pictures.recorded_scene import Motion

_INK, _BACK = (31, 41, 51, 255), (255, 255, 255, 205)
_COMMANDS = (("v_x", "forward", "m/s"), ("v_y", "sideways", "m/s"), ("w_z", "turning", "rad/s"))


def lines(motion: Motion, row: int, env_id: int | None = None) -> list[str]:
    """Return what is said of a frame: environment, iteration, time, and the command if there ever was one."""
    said = [f"t = {motion.time[row]:.2f} s"]
    if (iteration := motion.iteration_at(row)) is not None:
        said.insert(0, f"iteration {iteration}")
    if env_id is not None:
        said.insert(0, f"environment {env_id}")
    told = [
        f"{word} {motion.commands[name][row]:+.2f} {unit}"
        for name, word, unit in _COMMANDS
        if name in motion.commands and np.any(np.abs(np.nan_to_num(motion.commands[name])) > 1e-9)
    ]
    return [" · ".join(said), *(["command: " + ", ".join(told)] if told else [])]


def legend(motion: Motion) -> dict[str, tuple[float, ...]]:
    """Return the meaning and the colour of the arrows that are ever seen."""
    return {a.name: a.rgba for a in motion.arrows if any(np.abs(v).max(initial=0.0) > 0 for v in a.vectors)}


def write(
    pixels: NDArray[np.uint8], texts: Sequence[str], colours: Mapping[str, tuple[float, ...]]
) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) with texts at its lower left and the meaning of arrows at its lower right."""
    image = Image.fromarray(pixels).convert("RGBA")
    layer = Image.new("RGBA", image.size, (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    size = max(11, round(min(image.height / 34, image.width / 46)))
    font, pad = _font(size), round(0.55 * size)
    _texts(draw, texts, font, pad, image.height)
    _legend(draw, colours, font, pad, image.size)
    return np.asarray(Image.alpha_composite(image, layer).convert("RGB"))


def _texts(
    draw: ImageDraw.ImageDraw, texts: Sequence[str], font: ImageFont.FreeTypeFont, pad: int, height: int
) -> None:
    if not texts:
        return
    step = round(1.35 * font.size)
    width = max(draw.textlength(text, font) for text in texts)
    top = height - 2 * pad - len(texts) * step - pad
    draw.rounded_rectangle((pad, top, pad + width + 2 * pad, height - pad), round(0.6 * pad), fill=_BACK)
    for i, text in enumerate(texts):
        draw.text((2 * pad, top + 0.6 * pad + i * step), text, _INK, font)


def _legend(
    draw: ImageDraw.ImageDraw,
    colours: Mapping[str, tuple[float, ...]],
    font: ImageFont.FreeTypeFont,
    pad: int,
    size: tuple[int, int],
) -> None:
    if not colours:
        return
    width, height = size
    step = round(1.35 * font.size)
    wide = max(draw.textlength(name, font) for name in colours) + 1.6 * font.size
    left, top = width - wide - 3 * pad, height - 3 * pad - len(colours) * step
    draw.rounded_rectangle((left, top, width - pad, height - pad), round(0.6 * pad), fill=_BACK)
    for i, (name, rgba) in enumerate(colours.items()):
        y = top + 0.6 * pad + i * step
        shade = tuple(round(255 * part) for part in rgba[:3])
        middle = y + 0.62 * font.size
        draw.line(
            (left + pad, middle, left + pad + 1.1 * font.size, middle), (*shade, 255), max(2, round(font.size / 5))
        )
        draw.text((left + pad + 1.6 * font.size, y), name, _INK, font)


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Return the font that matplotlib brings, so that pictures are the same everywhere."""
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)
