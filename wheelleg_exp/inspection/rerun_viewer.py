"""Rerun's viewer with one recording: in a window, in a browser, or as a screenshot.

Viewer and web server listen on the loopback address only. The web page loads nothing from other hosts: the server
removes fonts and usage statistics, and a content security policy stops the browser from requesting them.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import warnings
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import IO, TYPE_CHECKING, Self, cast
from urllib.parse import quote, urlsplit

from wheelleg_exp.child_process import running_program
from wheelleg_exp.errors import RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.files import require_new, write_new
from wheelleg_exp.recording.layout import SIM_TIME
from wheelleg_exp.recording.rerun_program import rerun_program
from wheelleg_exp.recording.writing.live_view import LOOPBACK, free_port, viewer_environment
from wheelleg_exp.rendering.renderer import NoGraphics

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

# If Rerun's viewer fails, an output line with a word such as "panic" or "error" reports the cause.
_CAUSES = ("adapter", "panic", "error", "failed")
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


@contextmanager
def viewer(arguments: Sequence[str]) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """Start Rerun's viewer without network access. Yield the viewer's process and its output file."""
    command = [rerun_program(), "--bind", LOOPBACK, *arguments]
    with (
        tempfile.TemporaryDirectory(prefix="wheelleg-viewer-") as folder,
        tempfile.TemporaryFile() as output,
        running_program(command, output, viewer_environment(), folder) as process,
    ):
        yield process, output


def failure_line(output: IO[bytes]) -> str:
    """Return the line of the viewer's output that most likely explains the viewer's failure."""
    output.seek(0)
    text = output.read().decode(errors="replace")
    lines = [line for line in (_COLOUR.sub("", raw).strip() for raw in text.splitlines()) if line]
    for word in _CAUSES:
        if found := [line for line in lines if word in line.lower()]:
            return found[0][:300]
    return lines[-1][:300] if lines else "no output"


RECORDING = "/recording.rrd"
_FILES = ("", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico", "apple-touch-icon.png", "sw.js")
_ELSEWHERE = re.compile(r"<link\b[^>]*https?://[^>]*>")
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self' data: blob:; worker-src 'self' blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_WEB_START_S = 20.0
_PIECE = 1 << 20

Files = Mapping[str, tuple[str, bytes]]


class WebViewer(ThreadingHTTPServer):
    """A local web server for Rerun's web viewer and one recording, by default at a free port."""

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, path: Path, port: int = 0) -> None:
        if not Path(path).is_file():
            raise RunDirectoryError(f"the recording '{path}' does not exist", expected="a Rerun recording")
        self.recording, self.files = Path(path), viewer_files()
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except (OSError, OverflowError) as error:
            message = f"cannot listen on port {port}: {error}"
            raise WheellegError(message, key="--port", expected="a free port, or none") from error
        self._thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)

    @property
    def port(self) -> int:
        return self.server_port

    @property
    def url(self) -> str:
        return f"http://{LOOPBACK}:{self.port}/"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()
        self._thread.join()

    def handle_error(self, *_: object) -> None:
        pass  # Ignore a closed connection, because a browser can close its connection at any time.


def viewer_files() -> Files:
    """Return the content and MIME type of each file of Rerun's web viewer, by URL path."""
    port, grpc = free_port(), free_port()
    arguments = ["--serve-web", "--port", str(grpc), "--web-viewer-port", str(port)]
    opener, found = urllib.request.build_opener(urllib.request.ProxyHandler({})), dict[str, tuple[str, bytes]]()
    with viewer(arguments) as (process, output):
        end = time.monotonic() + _WEB_START_S
        while len(found) < len(_FILES):
            try:
                for name in _FILES:
                    with opener.open(f"http://{LOOPBACK}:{port}/{name}", timeout=_WEB_START_S) as answer:
                        found[f"/{name}"] = (answer.headers.get_content_type(), answer.read())
            except OSError as error:
                if process.poll() is not None or time.monotonic() > end:
                    raise SimulationFailure(f"Rerun's web viewer does not start: {failure_line(output)}") from error
                time.sleep(0.05)
    kind, page = found["/"]
    return {**found, "/": (kind, _ELSEWHERE.sub("", page.decode()).encode())}


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def log_message(self, *_: object) -> None:
        pass

    def _answer(self, *, with_body: bool) -> None:
        server = cast(WebViewer, self.server)
        if self.headers.get("Host") not in (f"{LOOPBACK}:{server.port}", f"localhost:{server.port}"):
            self._reply(HTTPStatus.FORBIDDEN)  # Reject host names except loopback names, to prevent DNS rebinding.
            return
        address, ok = urlsplit(self.path), HTTPStatus.OK
        if address.path == "/" and "url=" not in address.query:
            # Redirect the browser to the URL that shows the recording in Rerun's web viewer.
            page = f"http://{self.headers['Host']}/"
            query = f"url={quote(page.rstrip('/') + RECORDING, safe='')}&hide_welcome_screen=1&persist=0"
            self._reply(HTTPStatus.FOUND, {"Location": f"{page}?{query}"})
        elif address.path == RECORDING and server.recording.is_file():
            with server.recording.open("rb") as file, suppress(ConnectionError):
                # Send only the file's present bytes, because a training can append to the file during the transfer.
                left = file.seek(0, 2)
                file.seek(0)
                self._reply(ok, {"Content-Type": "application/octet-stream", **_HEADERS}, left)
                while with_body and left and (piece := file.read(min(_PIECE, left))):
                    self.wfile.write(piece)
                    left -= len(piece)
        elif address.path in server.files:
            kind, body = server.files[address.path]
            self._reply(ok, {"Content-Type": kind, **_HEADERS}, len(body))
            if with_body:
                self.wfile.write(body)
        else:
            self._reply(HTTPStatus.NOT_FOUND)

    def _reply(self, status: HTTPStatus, headers: Mapping[str, str] | None = None, length: int = 0) -> None:
        self.send_response(status)
        for name, value in {**(headers or {}), "Content-Length": str(length)}.items():
            self.send_header(name, value)
        self.end_headers()


INSTALL = "a Vulkan driver; on Debian or Ubuntu: apt install mesa-vulkan-drivers libvulkan1"
_START_S, _ENDING_S, _SETTLE_S, _STILL = 30.0, 2.0, 0.4, 3


def open_window(path: Path) -> None:
    """Show a recording in a window of Rerun's viewer until the user closes the window."""
    if not has_display():
        expected = "a desktop; --web serves the viewer for a browser, --screenshot OUT.png --viewer draws a picture"
        raise WheellegError("this machine has no display for a viewer window", key="--open", expected=expected)
    with viewer(["--port", str(free_port()), "--hide-welcome-screen", str(path.absolute())]) as (process, output):
        if process.wait() != 0:
            raise SimulationFailure(f"Rerun's viewer ended with status {process.returncode}: {failure_line(output)}")


def has_display() -> bool:
    """Return whether this machine has a display on which a window can be opened."""
    return not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def serve(path: Path, say: Callable[[str], None], *, port: int = 0, browser: bool = True) -> None:
    """Serve a recording in Rerun's web viewer on the loopback address until Ctrl-C; ``say`` prints for the user."""
    with WebViewer(path, port) as running:
        say(f"the viewer is at {running.url}")
        opened = browser and _open_browser(running.url)
        say("Ctrl-C stops it" if opened else "open this address in a browser on this machine; Ctrl-C stops it")
        while True:
            time.sleep(3600.0)


def viewer_screenshot(path: Path, output: Path, *, time_s: float | None, width: int = 1600, height: int = 900) -> None:
    """Write a screenshot of Rerun's viewer at ``time_s``, s; raise NoGraphics without a Vulkan driver."""
    if output.suffix.lower() != ".png":
        raise WheellegError(f"'{output}' has no image suffix", expected="a name that ends with .png")
    require_new(output)
    port = free_port()
    arguments = ["--headless", "--port", str(port), "--window-size", f"{width}x{height}", "--hide-welcome-screen"]
    with viewer(arguments) as (process, log), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Suppress Rerun's warning that the class ViewerClient is experimental.
        try:
            client = _connected(port, process, log)
            client.open(str(path.absolute()))
            if time_s is not None:
                client.set_time(SIM_TIME, duration=time_s, play_state="paused")
            picture = _still(client)
        except (RuntimeError, ConnectionError, TimeoutError) as error:
            with suppress(subprocess.TimeoutExpired):  # Without a Vulkan driver, Rerun's viewer exits after its start.
                process.wait(_ENDING_S)
            if process.returncode is not None:
                raise _no_graphics(log) from error
            raise SimulationFailure(f"Rerun's viewer cannot draw: {str(error).splitlines()[0]}") from error
    write_new(output, picture)


def _connected(port: int, process: subprocess.Popen[bytes], output: IO[bytes]) -> ViewerClient:
    from rerun.experimental import ViewerClient

    end = time.monotonic() + _START_S
    while True:
        if process.poll() is not None:
            raise _no_graphics(output)
        try:
            return ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        except ConnectionError as error:
            if time.monotonic() > end:
                raise SimulationFailure(f"Rerun's viewer does not answer: {failure_line(output)}") from error
            time.sleep(0.1)


def _no_graphics(output: IO[bytes]) -> NoGraphics:
    return NoGraphics(f"the viewer cannot be drawn on this machine ({failure_line(output)})", expected=INSTALL)


def _still(client: ViewerClient) -> bytes:
    """Wait until two consecutive screenshots are equal, because Rerun's viewer loads data over several frames."""
    now = bytes(client.take_screenshot())
    for _ in range(_STILL):
        time.sleep(_SETTLE_S)
        before, now = now, bytes(client.take_screenshot())
        if now == before:
            break
    return now


def _open_browser(url: str) -> bool:
    with suppress(webbrowser.Error):
        return has_display() and webbrowser.open(url)
    return False
