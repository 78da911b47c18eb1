"""Show a growing recording in rerun's viewer, from a process of its own that follows the file."""

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
from typing import TYPE_CHECKING, Any

import rerun as rr
from rerun.chunk import Chunk, RrdReader

from wheelleg_exp.recording.blueprint import blueprint
from wheelleg_exp.recording.rerun_program import rerun_program
from wheelleg_exp.recording.rrd_file import APPLICATION, HEADER_SIZE, STORE_INFO, RrdFile

if TYPE_CHECKING:  # the recorder loads torch and mujoco, which `wheelleg inspect` does not need
    from wheelleg_exp.recording.writing.recorder import Recorder

LOOPBACK = "127.0.0.1"
LAYOUT = "layout.pickle"
_POLL_S, _START_S, _STUCK_S = 0.2, 30.0, 10.0
_CHUNKS_PER_FLUSH = 500  # chunks that are sent before the viewer must have received them
_NOWHERE = f"http://{LOOPBACK}:9"  # the port of the discard service, on which nothing listens


class ViewerLostError(Exception):
    """The viewer does not run, or receives nothing."""


def viewer_command(port: int | str) -> list[str]:
    """Return the command that opens rerun's viewer for this machine alone."""
    return [rerun_program(), "--bind", LOOPBACK, "--port", str(port), "--expect-data-soon", "--hide-welcome-screen"]


def viewer_environment() -> dict[str, str]:
    """Return an environment in which the viewer sends nothing anywhere and leaves the user's settings alone.

    rerun's analytics are off when ``CI`` is set; its settings file is the user's, and is not changed. Its search for
    updates has no switch, so it gets a proxy that does not exist.
    """
    proxies = {name: _NOWHERE for word in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY") for name in (word, word.lower())}
    here = dict.fromkeys(("NO_PROXY", "no_proxy"), f"{LOOPBACK},localhost,::1")
    return {**os.environ, "CI": "true", **proxies, **here}


class Follower:
    """Reads the whole messages of a growing file, each once; also when the file's name is given to another file.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._file = RrdFile(path)
        self._place = HEADER_SIZE
        self._announced = b""  # the messages that announce a recording, without which its rows cannot be read

    def chunks(self) -> Iterator[tuple[str, Chunk]]:
        """Yield the id of the recording and the chunks that have become whole since the last call."""
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
                warnings.simplefilter("ignore")  # rerun warns of a file without an index
                reader = RrdReader(segment.name)
                for entry in reader.recordings():
                    for chunk in reader.stream(store=entry):
                        yield entry.recording_id, chunk


class Feed:
    """Sends a growing recording to a viewer.

    Args:
        path: the recording.
        folder: the folder of the run's present layout.
        port: the port of the viewer.
        is_open: returns whether the viewer still runs.
    """

    def __init__(self, path: Path, folder: Path, port: int, is_open: Callable[[], bool] = lambda: True) -> None:
        self._is_open = is_open
        self._follower, self._layout = Follower(path), folder / LAYOUT
        self._url = f"rerun+http://{LOOPBACK}:{port}/proxy"
        self._stream: rr.RecordingStream | None = None
        self._layout_time = -1

    def step(self) -> None:
        """Send the new chunks.

        Raises:
            ViewerLostError: the viewer does not receive them.
        """
        for number, (recording_id, chunk) in enumerate(self._follower.chunks(), start=1):
            self._connected(recording_id).send_chunks(chunk)
            if number % _CHUNKS_PER_FLUSH == 0:
                self._flush()
        self._send_layout()
        self._flush()

    def _connected(self, recording_id: str) -> rr.RecordingStream:
        if self._stream is None:
            self._stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
            self._stream.connect_grpc(self._url)
        return self._stream

    def _send_layout(self) -> None:
        if self._stream is None or not self._layout.exists():
            return
        written = self._layout.stat().st_mtime_ns
        if written != self._layout_time:
            self._layout_time = written
            layouts, purpose, documents, training = pickle.loads(self._layout.read_bytes())
            self._stream.send_blueprint(blueprint(layouts, purpose, documents=documents, training=training))

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
                    raise ViewerLostError("it was closed") from error
                if time.monotonic() > end:
                    raise ViewerLostError("it receives nothing any more") from error


def follow(path: Path, folder: Path, viewer: Sequence[str]) -> None:
    """Open a viewer and send the recording to it until standard input ends, which happens when the run ends.

    Raises:
        ViewerLostError: the viewer cannot be opened, is closed, or receives nothing.
    """
    port = free_port()
    process = _open([word.replace("{port}", str(port)) for word in viewer] or viewer_command(port))
    _wait_for(port, process)
    feed, is_over = Feed(path, folder, port, lambda: process.poll() is None), False
    while True:
        is_over = is_over or _ended(_POLL_S)
        if process.poll() is not None:
            raise ViewerLostError("it was closed")
        feed.step()
        if is_over:
            return


def _open(command: list[str]) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(
            command,
            env=viewer_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        raise ViewerLostError(str(error)) from error


def _wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + _START_S
    while time.monotonic() < end:
        if process.poll() is not None:
            raise ViewerLostError("it cannot be opened; is there a display?")
        try:
            with socket.create_connection((LOOPBACK, port), timeout=1.0):
                return
        except OSError:
            time.sleep(0.1)
    raise ViewerLostError("it does not answer")


def free_port() -> int:
    """Return a free port of the loopback address."""
    with socket.socket() as found:
        found.bind((LOOPBACK, 0))
        return int(found.getsockname()[1])


def _ended(wait_s: float) -> bool:
    """Return whether standard input ends within a time."""
    ready, _, _ = select.select([sys.stdin.fileno()], [], [], wait_s)
    return bool(ready) and not os.read(sys.stdin.fileno(), 1024)


def main(words: list[Any]) -> None:
    """Follow the file ``words[0]`` with layouts from ``words[1]``; more words are the command of another viewer."""
    os.nice(5)
    folder = Path(words[1])
    try:
        follow(Path(words[0]), folder, words[2:])
    except ViewerLostError as error:
        with contextlib.suppress(OSError):  # the run, which prints the message, may have ended
            os.write(sys.stdout.fileno(), f"wheelleg: no live view: {error}; the run goes on\n".encode())
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)  # at a normal exit, rerun would wait for a viewer that was closed


class LiveView:
    """Opens a viewer, and sends the recording's file to it from a process of its own.

    The run only writes its file, as without a viewer. A viewer that is slow, hangs, dies or cannot be opened costs the
    run neither time nor memory. The process ends with the run. The viewer stays open.

    Args:
        recorder: the recording, open and flushed.
        viewer: the viewer's command with ``{port}`` in place of the port; None for rerun's viewer.
    """

    def __init__(self, recorder: Recorder, viewer: Sequence[str] | None = None) -> None:
        self._recorder = recorder
        self._shown: tuple[int, int] | None = None
        self._folder = Path(tempfile.mkdtemp(prefix="wheelleg-live-"))
        self._write_layout()
        module = "wheelleg_exp.recording.writing.live_view"
        words = [sys.executable, "-P", "-m", module, str(recorder.path), str(self._folder)]
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.suppress(OSError):  # no more processes: then there is no live view
            self._process = subprocess.Popen(
                [*words, *(viewer or [])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            threading.Thread(target=_attend, args=(self._process,), daemon=True).start()

    def show(self) -> None:
        """Update the viewer's layout for the data recorded so far."""
        self._write_layout()

    def close(self) -> None:
        """Tell the process that the file is closed; it sends the remaining chunks and ends."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def _write_layout(self) -> None:
        state = self._recorder.layout_state()
        if self._shown == (len(state[2]), len(state[3])):
            return
        self._shown = (len(state[2]), len(state[3]))
        with contextlib.suppress(OSError):
            temporary = self._folder / f"{LAYOUT}.tmp"
            temporary.write_bytes(pickle.dumps(state))
            temporary.replace(self._folder / LAYOUT)


def _attend(process: subprocess.Popen[bytes]) -> None:
    """Print the messages of the process during the run."""
    if process.stdout is not None:
        with process.stdout as words:
            for line in words:
                sys.stderr.write(line.decode(errors="replace"))
    process.wait()


if __name__ == "__main__":
    main(sys.argv[1:])
