import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE_S, wait_until

from browser.chrome import Chrome
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.jobs.drive.drive_page import SLOW, DrivePage
from wheelleg_exp.jobs.drive.drive_script import Finish, Push, Reset
from wheelleg_exp.jobs.drive.run_drive import Drive, DriveRequest, drive
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.browser
pytest.importorskip("viser", reason="the extra 'drive' is not installed")
pytest.importorskip("mjviser", reason="the extra 'drive' is not installed")

_RANGES = [f"env.commands.base_velocity.ranges.{axis}=[-0.3,0.3]" for axis in ("lin_vel_x", "ang_vel_z")]


class Silent:
    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_: None


@dataclass
class Driving:
    page: DrivePage
    chrome: Chrome
    made: list[Drive] = field(default_factory=list)

    @property
    def controls(self) -> Any:
        return self.page._controls

    def key(self, code: str, key: str, *, down: bool) -> None:
        kind = "keyDown" if down else "keyUp"
        self.chrome.driver.execute_cdp_cmd("Input.dispatchKeyEvent", {"type": kind, "code": code, "key": key})

    def shown(self, axis: str) -> float | None:
        found = self.chrome.script(f"return document.querySelector('[data-axis={axis}]')?.dataset.command")
        return None if found is None else float(found)

    def text(self) -> str:
        return self.chrome.script("return document.querySelector('#drive-time')?.innerText ?? ''")


@pytest.fixture(scope="module")
def driving(chrome: Chrome, played: RunDirectory) -> Iterator[Driving]:
    """Open the page of a policy once, because the browser loads it slowly; the test of the keys ends the drive."""
    with DrivePage(0, ["own", "rough"], []) as page:
        found = Driving(page, chrome)
        wish = DriveRequest(played, overrides=[*_RANGES, "drive.fall_shown_s=0.1"])
        thread = threading.Thread(target=lambda: found.made.extend(drive(wish, Silent(), page)))
        thread.start()
        try:
            chrome.size(760, 600)
            chrome.open(page.url)
            yield found
        finally:
            wait_until(lambda: hasattr(page, "_controls"))
            page._controls.request(Finish())
            thread.join()


# A simulated gamepad. As in browsers, each call of getGamepads returns a new object.
_PAD = """
window.pad = {axes: [0, 0, 0, 0], down: []};
navigator.getGamepads = () => [null, {
  connected: true, mapping: 'standard', axes: window.pad.axes,
  buttons: Array.from({length: 17}, (_, i) => ({pressed: window.pad.down.includes(i), value: 0})),
}, null, null];
"""


def test_a_gamepad_drives(driving: Driving, monkeypatch: pytest.MonkeyPatch):
    chrome, asked = driving.chrome, {"lin_vel_x": 0.0, "ang_vel_z": 0.0}

    def sticks(left_x: float, left_y: float, right_x: float, right_y: float = 0.0) -> None:
        chrome.script(f"window.pad.axes = [{left_x}, {left_y}, {right_x}, {right_y}]")

    def press(button: int) -> None:
        chrome.script(f"window.pad.down = [{button}]; return new Promise(done => setTimeout(done, 200))")

    def asks(**values: float) -> bool:
        return wait_until(lambda: driving.controls.values == pytest.approx({**asked, **values}, abs=1e-6))

    assert wait_until(lambda: chrome.script("return window.wheellegDrive?.socket.readyState === 1"))
    assert wait_until(lambda: driving.shown("lin_vel_x") == 0.0)
    chrome.script(_PAD)
    sticks(0.0, -1.0, 0.0)  # The left stick points forwards.
    assert asks(lin_vel_x=0.3)
    assert wait_until(lambda: driving.shown("lin_vel_x") == 0.3)  # The command is 0.3 m/s.
    sticks(0.9, 0.5, 1.0)  # The left stick is half back, the right stick right.
    assert asks(lin_vel_x=-0.15, ang_vel_z=-0.3)
    sticks(0.0, 0.1, -0.1, 1.0)  # All sticks are in the dead zone.
    assert asks()
    driving.controls.set("lin_vel_x", 0.2)  # A gamepad at rest does not override a slider.
    assert chrome.script("return new Promise(done => setTimeout(() => done(true), 200))")
    assert driving.controls.values["lin_vel_x"] == 0.2

    requests: list[Any] = []
    request = driving.controls.request
    monkeypatch.setattr(driving.controls, "request", lambda one: (requests.append(one), request(one)))
    press(9)
    assert wait_until(lambda: driving.controls.paused and "paused" in driving.text())
    assert driving.controls.paused  # A held button acts once.
    for button in (0, 1, 2, 9):
        press(button)
    chrome.script("window.pad.down = []")
    assert wait_until(lambda: not driving.controls.paused)
    assert (requests, driving.controls.speed) == ([Push(driving.page._hands.push), Reset()], SLOW)

    sticks(0.0, -1.0, 0.0)
    assert asks(lin_vel_x=0.3)
    chrome.script("navigator.getGamepads = () => [null, null, null, null]")  # The gamepad is disconnected.
    assert asks()


def test_keys_drive_and_the_page_shows_it(driving: Driving):
    chrome = driving.chrome
    if not chrome.script("return !!document.createElement('canvas').getContext('webgl2')"):
        pytest.skip("this browser has neither WebGL nor a software renderer for it")
    assert wait_until(lambda: chrome.script("return window.wheellegDrive?.socket.readyState === 1"))
    assert wait_until(lambda: driving.shown("lin_vel_x") == 0.0)

    driving.key("KeyW", "w", down=True)
    assert wait_until(lambda: driving.shown("lin_vel_x") == 0.3)
    driving.key("ArrowRight", "ArrowRight", down=True)
    assert wait_until(lambda: driving.shown("ang_vel_z") == -0.3)
    assert driving.controls.values == {"lin_vel_x": 0.3, "ang_vel_z": -0.3}
    # The robot is coloured and the ground is grey. The panel, which is 320 pixels wide, does not hide the robot.
    assert wait_until(lambda: len(_warm(chrome)) > 5000)
    middle = _warm(chrome).mean(axis=0)
    assert middle == pytest.approx((300, 220), abs=90)
    assert chrome.driver.title.startswith("wheelleg_exp")
    box = chrome.script("return document.querySelector('#drive-keys').getBoundingClientRect().toJSON()")
    assert box["left"] > 0
    assert box["bottom"] < 600
    assert box["right"] < 440
    driving.key("KeyW", "w", down=False)
    driving.key("ArrowRight", "ArrowRight", down=False)
    assert wait_until(lambda: (driving.shown("lin_vel_x"), driving.shown("ang_vel_z")) == (0.0, 0.0))

    driving.key("Space", " ", down=True)
    driving.key("Space", " ", down=False)
    assert wait_until(lambda: "paused" in driving.text())
    still = driving.text()
    assert driving.controls.paused
    driving.key("Space", " ", down=True)
    driving.key("Space", " ", down=False)
    assert wait_until(lambda: driving.text() not in (still, ""))

    box = chrome.driver.find_elements("css selector", "input.mantine-NumberInput-input")[0]
    box.send_keys("\ue009a\ue000", "0.15", "\ue007")  # The keys are Ctrl-A, the number, and Enter.
    assert wait_until(lambda: driving.controls.values["lin_vel_x"] == pytest.approx(0.15))

    hosts = {url.split("/")[2] for url in chrome.requests() if url.startswith("http")}
    assert hosts == {driving.page.url.split("/")[2]}  # The page loads no file from other hosts.
    chrome.open("about:blank")  # Leaving the page resets the command.
    driving.controls.request(Finish())
    assert wait_until(lambda: driving.made)
    figures = driving.made[0].figures
    assert figures["steps"] > 10
    assert (driving.made[0].folder / "recording.rrd").is_file()


def test_a_port_in_use_is_reported():
    with DrivePage(0, ["own"], []) as page:
        second = DrivePage(int(page.url.rsplit(":", 1)[1].strip("/")), ["own"], [])
        with pytest.raises(WheellegError, match=r"--port: port .* is in use"):
            second.__enter__()


def test_pages_of_others_are_refused():
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

    with DrivePage(0, ["own"], []) as page:
        hands = page._hands._server.socket.getsockname()[1]
        with pytest.raises(WebSocketException), connect(f"ws://127.0.0.1:{hands}/", origin="http://elsewhere.org"):
            pass
        address, version = page.url.replace("http", "ws"), _version()
        with connect(address, origin="http://elsewhere.org", subprotocols=[version]) as stranger:
            with suppress(WebSocketException):
                while stranger.recv(timeout=PATIENCE_S):
                    pass
            assert stranger.close_code == 1008


def _version() -> Any:
    import viser

    return f"viser-v{viser.__version__}"


def _warm(chrome: Chrome) -> Any:
    """Return row and column of the pixels of the robot's body, left of the panel."""
    picture = chrome.picture()[:, :440].astype(int)
    return np.argwhere((picture[..., 0] - picture[..., 2] > 60) & (picture[..., 0] >= picture[..., 1]))
