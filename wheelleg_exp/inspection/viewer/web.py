"""Rerun's web viewer with one recording in it, served on the loopback address and nowhere else.

The page may load nothing from elsewhere: fonts and usage statistics that the viewer's own page asks for are left out,
and a content security policy keeps the browser from asking.
"""

from __future__ import annotations

import re
import threading
import time
import urllib.request
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self, cast
from urllib.parse import quote, urlsplit

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.inspection.viewer.viewer_process import last_words, viewer
from wheelleg_exp.recording.writing.feed import LOOPBACK, free_port

RECORDING = "/recording.rrd"
_FILES = ("", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico", "apple-touch-icon.png", "sw.js")
_ELSEWHERE = re.compile(r"<link\b[^>]*https?://[^>]*>")
_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "connect-src 'self' data: blob:",
        "worker-src 'self' blob:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
_START_S = 20.0
_PIECE = 1 << 20

Files = Mapping[str, tuple[str, bytes]]


class WebViewer:
    """A server of the web viewer and one recording; ``with`` starts and ends it.

    Args:
        path: the recording.
        port: of the loopback address; 0 takes a free one.

    Raises:
        WheellegError: the port is taken, or the viewer does not start.
    """

    def __init__(self, path: Path, port: int = 0) -> None:
        if not Path(path).is_file():
            raise RunDirectoryError(f"there is no recording '{path}'", expected="a rerun recording")
        files = viewer_files()
        try:
            self._server = _Server((LOOPBACK, port), partial(_Handler, files, Path(path)))
        except (OSError, OverflowError) as error:
            raise WheellegError(
                f"port {port} cannot be listened on: {error}", key="--port", expected="a free port, or none"
            ) from error
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """What a browser opens."""
        return f"http://{LOOPBACK}:{self.port}/"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def viewer_files() -> Files:
    """Return the files of the web viewer by path, with their types, as rerun's own server hands them out.

    Raises:
        SimulationFailure: rerun's server does not start.
    """
    port, grpc = free_port(), free_port()
    arguments = ["--serve-web", "--port", str(grpc), "--web-viewer-port", str(port)]
    with viewer(arguments) as (process, said):
        end = time.monotonic() + _START_S
        while True:
            try:
                return {f"/{name}": _fetched(port, name) for name in _FILES}
            except OSError as error:
                if process.poll() is not None or time.monotonic() > end:
                    raise SimulationFailure(f"the web viewer does not start: {last_words(said)}") from error
                time.sleep(0.05)


def page_url(base: str) -> str:
    """Return the address that shows the recording in the viewer."""
    return f"{base}?url={quote(base.rstrip('/') + RECORDING, safe='')}&hide_welcome_screen=1&persist=0"


def _fetched(port: int, name: str) -> tuple[str, bytes]:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(f"http://{LOOPBACK}:{port}/{name}", timeout=_START_S) as answer:
        kind, body = answer.headers.get_content_type(), answer.read()
    if not name:
        body = _ELSEWHERE.sub("", body.decode()).encode()
    return kind, body


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, files: Files, recording: Path, *args: Any) -> None:
        self._files, self._recording = files, recording
        super().__init__(*args)

    def do_GET(self) -> None:
        """Answer with a file of the viewer, or the recording."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Answer as to GET, without the content."""
        self._answer(with_body=False)

    def log_message(self, *_: Any) -> None:
        """Say nothing."""

    def _answer(self, *, with_body: bool) -> None:
        _, port = cast("tuple[str, int]", self.server.server_address)
        if self.headers.get("Host") not in (f"{LOOPBACK}:{port}", f"localhost:{port}"):
            self._empty(HTTPStatus.FORBIDDEN)  # a foreign page that made its name point here
            return
        address = urlsplit(self.path)
        if address.path == "/" and "url=" not in address.query:
            self._empty(HTTPStatus.FOUND, Location=page_url(f"http://{self.headers['Host']}/"))
        elif address.path == RECORDING:
            self._send_recording(with_body)
        elif address.path in self._files:
            kind, body = self._files[address.path]
            self._head(kind, len(body))
            if with_body:
                self.wfile.write(body)
        else:
            self._empty(HTTPStatus.NOT_FOUND)

    def _send_recording(self, with_body: bool) -> None:
        """Send the file as it is now; a run may be writing to it."""
        try:
            file = self._recording.open("rb")
        except OSError:
            self._empty(HTTPStatus.NOT_FOUND)
            return
        with file, suppress(ConnectionError):
            left = file.seek(0, 2)
            file.seek(0)
            self._head("application/octet-stream", left)
            while with_body and left and (piece := file.read(min(_PIECE, left))):
                self.wfile.write(piece)
                left -= len(piece)

    def _head(self, kind: str, length: int) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()

    def _empty(self, status: HTTPStatus, **headers: str) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", "0")
        self.end_headers()
