"""Draws the pictures of docs/recordings.md from a run that was trained and played.

    wheelleg train task=stand agent.max_iterations=110
    wheelleg play latest
    python docs/images/make_recording_pictures.py runs/stand/<id>

The robot needs a driver that draws without a display (Debian: libegl1 libgl1-mesa-dri), the viewer a Vulkan driver
(mesa-vulkan-drivers libvulkan1), its picture in a browser Chromium with its driver (chromium chromium-driver).
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from wheelleg_exp.inspection import recorded_scene, recording_pictures, recording_plots
from wheelleg_exp.inspection.plot_data import Source
from wheelleg_exp.inspection.plot_style import Panel, figure_bytes, page
from wheelleg_exp.inspection.rerun_viewer import WebViewer, viewer_screenshot
from wheelleg_exp.recording.reading.recording_reader import Recording

HERE = Path(__file__).parent
LARGEST = 300_000  # bytes of a picture
SHOWN_S = 1.5
MENU = 38  # pixels; the viewer's menu bar shows warnings about this machine


def main(run: Path) -> None:
    """Write recording_*.png beside this file."""
    training = Recording(run / "recording.rrd")
    played = Recording(sorted(run.glob("play/*/recording.rrd"))[-1])
    save("robot", robot(played))
    save("samples", samples(training))
    save("training", panels(training, {"learning_curves": 4, "reward_shares": 1, "terminations": 1}))
    save("motion", panels(played, {"tracking": 6, "contact_forces": 2, "joints": 2}))
    save("viewer", viewer(played.path))
    save("web", browser(played.path))


def robot(recording: Recording) -> Image.Image:
    """Return the robot while it is played."""
    shown = recording_pictures.scenery(recording)
    row = recording_pictures.row_at(shown, time_s=SHOWN_S)
    return Image.fromarray(recording_pictures.picture(shown, row, 1200, 675))


def samples(recording: Recording) -> Image.Image:
    """Return three moments, side by side, of each of the first and the last sample of a training."""
    shown = recording_pictures.scenery(recording)
    first, last = (shown.samples[i].first for i in (0, -1))
    rows = [int(np.searchsorted(shown.motion.step, s + offset)) for s in (first, last) for offset in (10, 30, 44)]
    drawn = recording_pictures.pictures(shown, rows, 360, 270)
    told = [
        recorded_scene.write_caption(p, recorded_scene.caption_lines(shown.motion, r), {})
        for p, r in zip(drawn, rows, strict=True)
    ]
    return Image.fromarray(np.vstack([np.hstack(told[:3]), np.hstack(told[3:])]))


def panels(recording: Recording, wanted: dict[str, int]) -> Image.Image:
    """Return the first panels of some default figures."""
    source = Source(recording)
    sections: list[tuple[str, list[Panel]]] = [
        (recording_plots.PLOTS[name].title, recording_plots.PLOTS[name].panels(source)[:count])
        for name, count in wanted.items()
    ]
    return Image.open(io.BytesIO(figure_bytes(page([s for s in sections if s[1]]), "png")))


def viewer(path: Path) -> Image.Image:
    """Return rerun's viewer."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "viewer.png"
        viewer_screenshot(path, target, time_s=SHOWN_S, width=1400, height=800)
        return without_menu(target.read_bytes())


def browser(path: Path) -> Image.Image:
    """Return the web viewer in Chromium, once it has drawn what it loads."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    software = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for word in ("--headless=new", "--no-sandbox", "--window-size=1400,880", *software):
        options.add_argument(word)
    with WebViewer(path) as running:
        driver = webdriver.Chrome(options=options)
        try:
            driver.get(running.url)
            time.sleep(25.0)
            return without_menu(driver.get_screenshot_as_png())
        finally:
            driver.quit()


def without_menu(png: bytes) -> Image.Image:
    """Return a picture of the viewer without its menu bar."""
    image = Image.open(io.BytesIO(png))
    return image.crop((0, MENU, image.width, image.height))


def save(name: str, image: Image.Image) -> None:
    """Write a picture; one that is too large loses colours that nobody sees."""
    image = image.convert("RGB")
    for candidate in (image, image.quantize(256, dither=Image.Dither.NONE), image.quantize(96)):
        buffer = io.BytesIO()
        candidate.save(buffer, "PNG", optimize=True)
        if buffer.tell() < LARGEST:
            break
    (HERE / f"recording_{name}.png").write_bytes(buffer.getvalue())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
