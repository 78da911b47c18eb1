"""Looking at a recording in rerun's viewer: in a window, in a browser, or as a picture of it without either."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import warnings
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from wheelleg_exp.errors import SimulationFailure, WheellegError
from wheelleg_exp.files import require_new, write_new
from wheelleg_exp.inspection.viewer.viewer_process import last_words, viewer
from wheelleg_exp.inspection.viewer.web import WebViewer
from wheelleg_exp.recording.layout import SIM_TIME
from wheelleg_exp.recording.writing.feed import LOOPBACK, free_port
from wheelleg_exp.rendering.renderer import NoGraphics

INSTALL = "a Vulkan driver; on Debian or Ubuntu: apt install mesa-vulkan-drivers libvulkan1"
_START_S, _ENDING_S, _SETTLE_S, _STILL = 30.0, 2.0, 0.4, 3

Say = Callable[[str], None]


def open_window(path: Path) -> None:
    """Show a recording in a window, until that is closed.

    Raises:
        WheellegError: there is no display.
        SimulationFailure: the viewer ends by itself.
    """
    if not has_display():
        raise WheellegError(
            "there is no display for a window",
            key="--open",
            expected="a desktop; --web serves the viewer for a browser, --screenshot OUT.png --viewer draws a picture",
        )
    with viewer(["--port", str(free_port()), "--hide-welcome-screen", str(path.absolute())]) as (process, said):
        if process.wait() != 0:
            raise SimulationFailure(f"the viewer ended with status {process.returncode}: {last_words(said)}")


def has_display() -> bool:
    """Return whether a window can be opened."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def serve(path: Path, say: Say, *, port: int = 0, browser: bool = True) -> None:
    """Serve the web viewer with a recording on the loopback address, until interrupted.

    Args:
        path: the recording.
        say: receives the lines for people; the first ends with the address.
        port: where; 0 takes a free port.
        browser: whether a browser is opened, where there is one.

    Raises:
        WheellegError: the port is taken.
        KeyboardInterrupt: it was interrupted.
    """
    with WebViewer(path, port) as running:
        say(f"the viewer is at {running.url}")
        opened = browser and _open_browser(running.url)
        say("Ctrl-C ends it" if opened else "open this address in a browser on this machine; Ctrl-C ends it")
        while True:
            time.sleep(3600.0)


def viewer_screenshot(path: Path, output: Path, *, time_s: float | None, width: int = 1600, height: int = 900) -> None:
    """Write a picture of rerun's viewer with a recording in it; whole or not at all.

    Args:
        path: the recording.
        output: the picture, .png.
        time_s: the simulated time that it stands at, s; None is where the viewer begins.
        width: px.
        height: px.

    Raises:
        NoGraphics: there is no Vulkan driver; the message says what to install.
        WheellegError: the path is wrong.
    """
    if output.suffix.lower() != ".png":
        raise WheellegError(f"'{output}' says no kind of picture", expected="a name that ends with .png")
    require_new(output)
    port = free_port()
    arguments = ["--headless", "--port", str(port), "--window-size", f"{width}x{height}", "--hide-welcome-screen"]
    with viewer(arguments) as (process, said), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the client is experimental, and says so
        try:
            client = _connected(port, process, said)
            client.open(str(path.absolute()))
            if time_s is not None:
                client.set_time(SIM_TIME, duration=time_s, play_state="paused")
            picture = _still(client)
        except (RuntimeError, ConnectionError, TimeoutError) as error:
            with suppress(subprocess.TimeoutExpired):  # it answers first, and finds no driver then
                process.wait(_ENDING_S)
            if process.returncode is not None:
                raise _no_graphics(said) from error
            raise SimulationFailure(f"the viewer draws nothing: {str(error).splitlines()[0]}") from error
    write_new(output, picture)


def _connected(port: int, process: subprocess.Popen[bytes], said: IO[bytes]) -> Any:
    from rerun.experimental import ViewerClient

    end = time.monotonic() + _START_S
    while True:
        if process.poll() is not None:
            raise _no_graphics(said)
        try:
            return ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        except ConnectionError as error:
            if time.monotonic() > end:
                raise SimulationFailure(f"the viewer does not answer: {last_words(said)}") from error
            time.sleep(0.1)


def _no_graphics(said: IO[bytes]) -> NoGraphics:
    return NoGraphics(f"the viewer cannot be drawn on this machine ({last_words(said)})", expected=INSTALL)


def _still(client: Any) -> bytes:
    """Return a picture once two in a row are the same: data and plots come in over several frames."""
    before = bytes(client.take_screenshot())
    for _ in range(_STILL):
        time.sleep(_SETTLE_S)
        now = bytes(client.take_screenshot())
        if now == before:
            break
        before = now
    return before


def _open_browser(url: str) -> bool:
    """Open a browser if that can be seen."""
    if not has_display():
        return False
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
