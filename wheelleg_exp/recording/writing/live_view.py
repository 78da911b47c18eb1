"""Show a growing recording in Rerun's viewer. A child process sends the growing recording to Rerun's viewer."""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import rerun as rr
from rerun.chunk import Chunk, RrdReader

from wheelleg_exp.recording.blueprint import blueprint
from wheelleg_exp.recording.rerun_program import rerun_program
from wheelleg_exp.recording.rrd_file import APPLICATION, HEADER_SIZE, STORE_INFO, RrdFile

if TYPE_CHECKING:  # Do not import the recorder at run time, because its module imports torch and mujoco.
    from wheelleg_exp.recording.writing.recorder import Recorder

LOOPBACK = "127.0.0.1"
LAYOUT = "layout.pickle"
_POLL_S, _START_S, _STUCK_S = 0.2, 30.0, 10.0
_CHUNKS_PER_FLUSH = 500  # After 500 data chunks, wait until Rerun's viewer has received all of them.
_NOWHERE = f"http://{LOOPBACK}:9"  # Port 9 belongs to the discard service, and no server listens on this port.


class ViewerLostError(Exception):
    """Rerun's viewer does not run or does not receive data."""


def viewer_command(port: int | str) -> list[str]:
    """Return the command that opens a viewer of Rerun to which only programs on the same machine can connect."""
    return [rerun_program(), "--bind", LOOPBACK, "--port", str(port), "--expect-data-soon", "--hide-welcome-screen"]


def viewer_environment() -> dict[str, str]:
    """Return environment variables that prevent Rerun's viewer from sending data to other machines.

    The variable ``CI`` disables Rerun's analytics without changing the user's settings file. Rerun's search for updates
    cannot be disabled, so its proxy is an address that does not exist.
    """
    proxies = {name: _NOWHERE for word in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY") for name in (word, word.lower())}
    here = dict.fromkeys(("NO_PROXY", "no_proxy"), f"{LOOPBACK},localhost,::1")
    return {**os.environ, "CI": "true", **proxies, **here}


class Follower:
    """Reads a growing recording, and yields each complete message once, even if the recording is renamed."""

    def __init__(self, path: Path) -> None:
        self._file = RrdFile(path)
        self._place = HEADER_SIZE
        self._announced = b""  # Rerun needs all earlier ``STORE_INFO`` messages to decode later data.

    def chunks(self) -> Iterator[tuple[str, Chunk]]:
        """Yield each data chunk that the file received since the last call, with the id of its recording."""
        self._file.refresh()
        begin = self._place
        for message in self._file.messages(begin):
            self._place = message.end
            if message.kind == STORE_INFO:
                self._announced += self._file.read(message.begin, message.end)
        if self._place == begin:
            return
        with tempfile.NamedTemporaryFile(suffix=".rrd") as segment:
            segment.write(self._file.header + self._announced)
            segment.writelines(self._file.body(begin))
            segment.flush()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Suppress Rerun's warning about an rrd file without an index.
                reader = RrdReader(segment.name)
                for entry in reader.recordings():
                    for chunk in reader.stream(store=entry):
                        yield entry.recording_id, chunk


class Feed:
    """Sends a growing recording, and the viewer's layout from ``folder``, to Rerun's viewer while it ``is_open``."""

    def __init__(self, path: Path, folder: Path, port: int, is_open: Callable[[], bool] = lambda: True) -> None:
        self._is_open = is_open
        self._follower, self._layout = Follower(path), folder / LAYOUT
        self._url = f"rerun+http://{LOOPBACK}:{port}/proxy"
        self._stream: rr.RecordingStream | None = None
        self._layout_time = -1

    def step(self) -> None:
        """Send new data of the recording to Rerun's viewer; raise ViewerLostError if the viewer receives no data."""
        for number, (recording_id, chunk) in enumerate(self._follower.chunks(), start=1):
            if self._stream is None:
                self._stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
                self._stream.connect_grpc(self._url)
            self._stream.send_chunks(chunk)
            if number % _CHUNKS_PER_FLUSH == 0:
                self._flush()
        if self._stream is not None and self._layout.exists():
            written = self._layout.stat().st_mtime_ns
            if written != self._layout_time:
                self._layout_time = written
                layouts, purpose, documents, training = pickle.loads(self._layout.read_bytes())
                self._stream.send_blueprint(blueprint(layouts, purpose, documents=documents, training=training))
        self._flush()

    def _flush(self) -> None:
        if self._stream is None:
            return
        end = time.monotonic() + _STUCK_S
        while True:
            try:
                self._stream.flush(timeout_sec=0.5)
                return
            except (RuntimeError, ValueError) as error:
                if not self._is_open():
                    raise ViewerLostError("the viewer was closed") from error
                if time.monotonic() > end:
                    raise ViewerLostError("Rerun's viewer no longer receives data") from error


def follow(path: Path, folder: Path, viewer: Sequence[str]) -> None:
    """Open Rerun's viewer and send a growing recording to it, until the end of the run closes standard input."""
    port = free_port()
    command = [word.replace("{port}", str(port)) for word in viewer] or viewer_command(port)
    silent = subprocess.DEVNULL
    try:
        process = subprocess.Popen(
            command, env=viewer_environment(), stdin=silent, stdout=silent, stderr=silent, start_new_session=True
        )
    except OSError as error:
        raise ViewerLostError(str(error)) from error
    end = time.monotonic() + _START_S
    while True:
        if process.poll() is not None:
            raise ViewerLostError("Rerun's viewer stopped at its start; perhaps there is no display")
        try:
            with socket.create_connection((LOOPBACK, port), timeout=1.0):
                break
        except OSError as error:
            if time.monotonic() > end:
                raise ViewerLostError("Rerun's viewer does not answer") from error
            time.sleep(0.1)
    feed, is_over = Feed(path, folder, port, lambda: process.poll() is None), False
    while not is_over:
        ready, _, _ = select.select([sys.stdin.fileno()], [], [], _POLL_S)
        is_over = bool(ready) and not os.read(sys.stdin.fileno(), 1024)
        if process.poll() is not None:
            raise ViewerLostError("the viewer was closed")
        feed.step()


def free_port() -> int:
    """Return a free port of the loopback address."""
    with socket.socket() as found:
        found.bind((LOOPBACK, 0))
        return int(found.getsockname()[1])


def main(words: list[str]) -> None:
    """Send a growing recording to a viewer. ``words``: its path, the folder of layouts, a user-defined viewer."""
    os.nice(5)
    folder = Path(words[1])
    try:
        follow(Path(words[0]), folder, words[2:])
    except ViewerLostError as error:
        with contextlib.suppress(OSError):  # Writing fails if the parent process of the live view has ended.
            os.write(sys.stdout.fileno(), f"wheelleg: no live view: {error}; the run goes on\n".encode())
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)  # Skip Rerun's exit handler, which would wait for a viewer that the user has closed.


class LiveView:
    """Shows a recording in Rerun's viewer while the run writes the recording's file.

    A child process sends the file to the viewer, so that a slow or broken viewer does not slow down the run. It stops
    with the run; the viewer remains open. ``viewer`` is a user-defined command with the placeholder ``{port}``.
    """

    def __init__(self, recorder: Recorder, viewer: Sequence[str] | None = None) -> None:
        self._recorder = recorder
        self._shown: tuple[int, int] | None = None
        self._folder = Path(tempfile.mkdtemp(prefix="wheelleg-live-"))
        self.show()
        module = "wheelleg_exp.recording.writing.live_view"
        words = [sys.executable, "-P", "-m", module, str(recorder.path), str(self._folder), *(viewer or [])]
        self._process: subprocess.Popen[bytes] | None = None
        pipe, silent = subprocess.PIPE, subprocess.DEVNULL
        with contextlib.suppress(OSError):  # If the child process cannot start, the run continues without a viewer.
            self._process = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=silent, start_new_session=True)
            threading.Thread(target=_print_messages, args=(self._process,), daemon=True).start()

    def close(self) -> None:
        """Close the standard input of the child process, so that it sends the remaining data and stops."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def show(self) -> None:
        """Update the layout of Rerun's viewer, so that the viewer shows all data that has been recorded so far."""
        state = self._recorder.layout_state()
        before, self._shown = self._shown, (len(state[2]), len(state[3]))
        if self._shown != before:
            with contextlib.suppress(OSError):
                temporary = self._folder / f"{LAYOUT}.tmp"
                temporary.write_bytes(pickle.dumps(state))
                temporary.replace(self._folder / LAYOUT)


def _print_messages(process: subprocess.Popen[bytes]) -> None:
    if process.stdout is not None:
        with process.stdout as messages:
            for line in messages:
                sys.stderr.write(line.decode(errors="replace"))
    process.wait()


if __name__ == "__main__":
    main(sys.argv[1:])
