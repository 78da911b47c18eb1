"""Takes the picture of the report on a desk and on a phone, in Chromium, as a reader sees it.

    python docs/images/make_report_pictures.py RUN

RUN is a run directory with a play. Needs Chromium and its driver (Debian: chromium chromium-driver libosmesa6).
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from PIL import Image, ImageDraw

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

from browser.chrome import Chrome, programs  # noqa: E402

from wheelleg_exp.report import make_report  # noqa: E402

DESK, PHONE = (1280, 1760), (375, 880)  # CSS pixels
HEIGHT, GAP = 1100, 36  # of the picture of both, px
GROUND, EDGE = (222, 227, 233), (196, 204, 213)


def screen(chrome: Chrome, size: tuple[int, int], scale: float) -> Image.Image:
    """Return what is on a screen of this size."""
    chrome.size(*size, scale)
    time.sleep(0.5)
    return Image.fromarray(chrome.picture())


def both(desk: Image.Image, phone: Image.Image) -> Image.Image:
    """Return a desk's and a phone's screen side by side."""
    shown = [
        image.resize((image.width * HEIGHT // image.height, HEIGHT), Image.Resampling.LANCZOS)
        for image in (desk, phone)
    ]
    width = sum(image.width for image in shown) + 3 * GAP
    canvas = Image.new("RGB", (width, HEIGHT + 2 * GAP), GROUND)
    left, pen = GAP, ImageDraw.Draw(canvas)
    for image in shown:
        canvas.paste(image, (left, GAP))
        pen.rectangle((left - 1, GAP - 1, left + image.width, GAP + HEIGHT), outline=EDGE)
        left += image.width + GAP
    return canvas


def save(image: Image.Image, name: str) -> None:
    """Write a picture beside this file, in as few colours as do."""
    path = HERE / name
    image.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def main(run: Path) -> None:
    """Write report.png."""
    with tempfile.TemporaryDirectory() as folder, Chrome(*programs(), Path(folder) / "profile") as chrome:
        report = make_report(run, run.parents[1], Path(folder) / "report.html").path
        chrome.open(report.as_uri())
        desk = screen(chrome, DESK, 1.0)
        save(both(desk, screen(chrome, PHONE, 2.0)), "report.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
