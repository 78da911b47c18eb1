"""Takes the picture and the film of docs/drive.md: `stock:walk`, driven by keys in a real browser.

    wheelleg play stock:walk
    python docs/images/make_drive_pictures.py runs/stock/walk_<id>

Needs the extra `drive`, and Chromium with its driver (Debian: chromium chromium-driver). The simulation pauses for each
frame, so that a browser without a graphics card can draw it; the film plays in real time, and shows this rate.
"""

from __future__ import annotations

import io
import re
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from PIL import Image

from wheelleg_exp.jobs.drive import drive_page
from wheelleg_exp.jobs.drive.drive_page import DrivePage, state_html
from wheelleg_exp.jobs.drive.drive_script import Controls, Finish
from wheelleg_exp.jobs.drive.drive_session import Status
from wheelleg_exp.jobs.drive.run_drive import DriveRequest, drive, scenes
from wheelleg_exp.run.run_directory import RunDirectory

HERE = Path(__file__).parent
WIDTH, HEIGHT = 1100, 640
FILM = (660, 384)  # pixels
FRAME_S = 0.15  # of simulated time, between frames of the film
SLOW = 0.2
# Simulated seconds, and the keys that go down (+) or up (-) then.
KEYS: list[tuple[float, str, bool]] = [
    (0.5, "KeyW", True),
    (2.5, "KeyA", True),
    (5.5, "KeyA", False),
    (5.5, "KeyW", False),
    (6.5, "KeyF", True),
    (6.6, "KeyF", False),
    (7.5, "KeyS", True),
    (9.0, "KeyS", False),
]
END_S = 10.0
PICTURE_S = 4.0  # when the picture is taken


class Silent:
    """A display that shows nothing."""

    def __getattr__(self, name: str) -> Any:
        return lambda *_: None


def as_filmed(status: Status, controls: Controls, step_dt: float) -> str:
    """Return the state that the page shows, with the rate of the film instead of that of the recording."""
    shown = Controls(list(controls.axes.values()))
    return state_html(status, shown, step_dt)


def main(run: RunDirectory) -> None:
    """Write drive.png and drive.webp beside this file."""
    drive_page.state_html = as_filmed
    with DrivePage(0, scenes(), ["stock:walk", "stock:get_up"]) as page:
        thread = threading.Thread(
            target=drive, args=(DriveRequest(run, overrides=["drive.frames_per_s=10"]), Silent(), page)
        )
        thread.start()
        browser = opened(page.url)
        try:
            wait_for(browser, "return window.wheellegDrive && window.wheellegDrive.socket.readyState === 1")
            page._controls.speed = SLOW
            page._pause = SimpleNamespace()  # The button does not show that the simulation pauses for each frame.
            film = list(frames(browser, page._controls))
            save_film(film)
            save_picture("drive", next(image for moment, image in film if moment >= PICTURE_S))
        finally:
            page._controls.request(Finish())
            thread.join()
            browser.quit()


def opened(url: str) -> Any:
    """Return Chromium with the page."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    software = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for word in ("--headless=new", "--no-sandbox", f"--window-size={WIDTH},{HEIGHT + 140}", *software):
        options.add_argument(word)
    driver = webdriver.Chrome(options=options)
    size = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.get(url)
    return driver


def wait_for(browser: Any, script: str) -> None:
    """Wait until a script returns what counts as true."""
    while not browser.execute_script(script):
        time.sleep(0.1)


def frames(browser: Any, controls: Controls) -> Iterator[tuple[float, Image.Image]]:
    """Reset, press the keys, and yield pictures with their simulated time from then on, s."""
    without_notes(browser)
    time.sleep(2.0)  # until the scene has faded in
    begin, waiting, due = moment(browser), list(KEYS), 0.0
    while (now := moment(browser) - begin) < END_S:
        while waiting and waiting[0][0] <= now:
            _, code, down = waiting.pop(0)
            kind = "keyDown" if down else "keyUp"
            browser.execute_cdp_cmd("Input.dispatchKeyEvent", {"type": kind, "code": code, "key": code[-1].lower()})
        if now >= due:
            due = now + FRAME_S
            controls.paused = True
            yield moment(browser) - begin, shot(browser)
            controls.paused = False


def moment(browser: Any) -> float:
    """Return the simulated time that the page shows, s."""
    text = browser.execute_script("return document.querySelector('#drive-time').innerText")
    return float(re.match(r"[\d.]+", text)[0])  # type: ignore[index]


def without_notes(browser: Any) -> None:
    """Take viser's note about a browser without a graphics card away."""
    browser.execute_script("document.querySelectorAll('[class*=Notification]').forEach(e => e.remove())")


def shot(browser: Any) -> Image.Image:
    """Return what is on screen."""
    from selenium.common.exceptions import TimeoutException

    while True:
        try:
            return Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
        except TimeoutException:  # A busy machine draws slowly.
            time.sleep(1.0)


def save_film(film: list[tuple[float, Image.Image]]) -> None:
    """Write the film, each frame shown as long as the simulation took to the next."""
    moments = [when for when, _ in film]
    lasting = [round(1000 * (b - a)) for a, b in zip(moments, [*moments[1:], moments[-1] + 1.0], strict=True)]
    small = [image.resize(FILM, Image.Resampling.LANCZOS) for _, image in film]
    options = {"save_all": True, "loop": 0, "quality": 55, "method": 6}
    small[0].save(HERE / "drive.webp", append_images=small[1:], duration=lasting, **options)


def save_picture(name: str, image: Image.Image) -> None:
    """Write a picture; fewer colours would change those of the small bars."""
    image.save(HERE / f"{name}.png", optimize=True)


if __name__ == "__main__":
    path = Path(sys.argv[1])
    main(RunDirectory.open(path, path.parent.parent))
