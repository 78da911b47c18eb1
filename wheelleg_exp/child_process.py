"""Start, serve, and end child processes: jobs, workers, and other programs.

A job trains or evaluates. It reads a request from standard input, writes each event as a line of JSON to standard
output, and stops when its input ends, for example because the parent process was killed. Each line on its standard
error becomes a ``note`` event. A worker reads pickled requests and answers each with bytes, until its input ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from io import FileIO
from pathlib import Path
from typing import IO, Literal, Required, TypedDict, TypeVar, cast

from wheelleg_exp.errors import (
    EXIT_FAILED,
    EXIT_INPUT,
    EXIT_INTERRUPTED,
    EXIT_OK,
    Interrupted,
    RunDirectoryError,
    SimulationFailure,
    WheellegError,
)
from wheelleg_exp.machine import own_environ, prepare_threads, used_memory
from wheelleg_exp.stop_request import StopRequest


class JobError(TypedDict):
    """The error with which a job failed."""

    type: str
    message: str


class Event(TypedDict, total=False):
    """A message of a job's process; the value of ``event`` determines which other keys exist."""

    event: Required[str]
    path: str
    done: int
    total: int
    scalars: dict[str, float]
    text: str
    package: str
    equal: bool
    difference: str | None
    note: str | None
    folder: str
    metrics: dict[str, float | None]
    scenarios_sha256: str
    status: Literal["finished", "failed", "interrupted"]
    error: JobError | None


_READY = b"ready\n"
_T = TypeVar("_T")
_Order = TypeVar("_Order")
_Request = TypeVar("_Request")
_SET_PATH = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer)"
_CHUNK = 1 << 16
_WAIT_S = 0.2
_PATIENCE_S, _PROGRAM_PATIENCE_S, _WORKER_PATIENCE_S = 10.0, 5.0, 20.0
_LAST_LINES = 3
_KILL = getattr(signal, "SIGKILL", signal.SIGTERM)


# --- parent side ---


class Child:
    """The process of a job: it gets a request, sends events, and stops on request.

    It leads its own process group, so that Ctrl-C reaches only the parent, which then asks the job to stop after the
    current iteration. ``ended`` is the last event, or None. ``open`` maps each open pipe to its incomplete last line.
    """

    def __init__(
        self, program: Sequence[str], request: bytes, environ: Mapping[str, str], folder: Path | None = None
    ) -> None:
        self.process = subprocess.Popen(
            program,
            env=dict(environ),
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,
        )
        self.ended: Event | None = None
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        pipes = (self.process.stdin, self.process.stdout, self.process.stderr)
        self._input, self._output, self._errors = cast(tuple[IO[bytes], ...], pipes)
        self.open = {self._output: b"", self._errors: b""}
        for pipe in self.open:
            os.set_blocking(pipe.fileno(), False)
        with contextlib.suppress(OSError):  # The child process may be dead already; `_events` reports its death.
            self._input.write(request)
            self._input.flush()

    def ask_to_stop(self) -> None:
        with contextlib.suppress(OSError):
            self._input.close()

    def interrupt(self) -> None:
        """Send SIGTERM to a job that was already asked to stop, so that the job stops immediately."""
        self.process.send_signal(signal.SIGTERM)  # Use SIGTERM, because a shell's background job ignores SIGINT.

    def kill(self) -> None:
        self.process.kill()

    def over(self) -> bool:
        return self.process.poll() is not None

    def close(self) -> None:
        """Kill the job's child process if it runs, and close the pipes to the child process."""
        self.kill()
        self.process.wait()
        self.open = {}
        self.ask_to_stop()
        self._output.close()
        self._errors.close()

    def read(self, pipe: IO[bytes]) -> Iterator[Event]:
        """Yield the events of a job that can be read from a pipe without waiting."""
        found = self.open.pop(pipe)
        try:
            while chunk := os.read(pipe.fileno(), _CHUNK):
                found += chunk
            found += b"\n"
        except BlockingIOError:  # The pipe from the job's child process is open but currently empty.
            found, _, self.open[pipe] = found.rpartition(b"\n")
        for raw in filter(bytes.strip, found.split(b"\n")):
            line = raw.decode(errors="replace").rstrip()
            if pipe is self._errors:
                self._last_lines.append(line)
                yield {"event": "note", "text": line}
            elif (event := parse_event(line)) is not None:
                if event["event"] == "ended":
                    self.ended = event
                else:
                    yield event

    def describe_death(self) -> str:
        """Return how a job ended that sent no last event: its exit status or signal, and its last lines."""
        code = self.process.wait()
        if code >= 0:
            how = f"ended with status {code} and did not say why"
        else:
            name = signal.Signals(-code).name
            how = f"was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
        return how + "".join(f": {line.strip()}" for line in self._last_lines)


def listen(children: Iterable[Child], wait_s: float) -> Iterator[tuple[Child, Event]]:
    """Yield the events that child processes have sent; wait for the first event at most ``wait_s`` seconds."""
    with selectors.DefaultSelector() as selector:
        for child in children:
            for pipe in child.open:
                selector.register(pipe, selectors.EVENT_READ, child)
        ready = selector.select(wait_s)
    for key, _ in ready:
        for event in key.data.read(key.fileobj):
            yield key.data, event


def parse_event(line: str) -> Event | None:
    """Return the event that a line of a job's output contains; None for a line without an event."""
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return cast("Event", event) if isinstance(event, dict) and isinstance(event.get("event"), str) else None


@contextmanager
def job_events(child: Child, stop: StopRequest) -> Iterator[Iterator[Event]]:
    """Yield an iterator over a job's events; on exit, stop the job by a request, then by a signal, then by killing it.

    The returned iterator raises ``Interrupted`` if the job was stopped, and a WheellegError if the job failed.
    """
    try:
        yield _events(child, stop)
    finally:
        try:
            _end(child, child.ask_to_stop, 0.0 if stop.requested else _PATIENCE_S)
            _end(child, child.interrupt, _PATIENCE_S)
        finally:
            child.close()


def _events(child: Child, stop: StopRequest) -> Iterator[Event]:
    while child.open:
        if stop.requested:
            child.ask_to_stop()
        for _, event in listen([child], _WAIT_S):
            yield event
    status, ended = child.process.wait(), child.ended
    if ended is None and not stop.requested:
        raise SimulationFailure(f"the job's process {child.describe_death()}")
    if ended is None or ended["status"] == "interrupted":
        raise Interrupted
    if error := ended.get("error"):
        kind: type[WheellegError] = RunDirectoryError if status == EXIT_INPUT else SimulationFailure
        raise kind(str(error["message"]))


def _end(child: Child, act: Callable[[], None], patience_s: float) -> None:
    if child.over():
        return
    act()
    deadline = time.monotonic() + patience_s
    while not child.over() and time.monotonic() < deadline:
        for _ in listen([child], 0.05):  # Read the child's events, because a child with a full output pipe cannot end.
            pass


# --- job side ---


class EventPipe:
    """Sends a job's events to the parent; after ``reached`` is true, a stop request does not interrupt the job."""

    reached = False

    def __init__(self, descriptor: int) -> None:
        self._file = FileIO(descriptor, "w", closefd=False)

    def send(self, event: str, **facts: object) -> None:
        line = json.dumps({"event": event, **facts}, default=float) + "\n"
        data = memoryview(line.encode())
        with contextlib.suppress(OSError):
            while data:
                data = data[self._file.write(data) :]


def serve_job(work: Callable[[EventPipe, bytes, StopRequest], None]) -> int:
    """Read a job's request from the first line of standard input, run the job, and return its exit status."""
    prepare_threads()
    descriptor = os.dup(1)
    os.dup2(2, 1)
    with StopRequest() as stop:
        source = FileIO(0, "r", closefd=False)
        request = source.readline()
        threading.Thread(target=_stop_at_end, args=(source, stop), daemon=True).start()
        return run_job(EventPipe(descriptor), lambda pipe: work(pipe, request, stop))


def run_job(pipe: EventPipe, work: Callable[[EventPipe], None]) -> int:
    """Run a job in a child process, send an ``ended`` event to the parent process, and return the exit status."""
    try:
        work(pipe)
    except Interrupted:
        if not pipe.reached:
            pipe.send("ended", status="interrupted", error=None)
            return EXIT_INTERRUPTED
    except BaseException as error:
        pipe.send("ended", status="failed", error={"type": type(error).__name__, "message": str(error)})
        return error.exit_code if isinstance(error, WheellegError) else EXIT_FAILED
    pipe.send("ended", status="finished", error=None)
    return EXIT_OK


def _stop_at_end(source: FileIO, stop: StopRequest) -> None:
    while source.read(1):
        pass
    stop.requested = True


# --- a worker ---


class Worker:
    """A child process whose Python module answers pickled requests with bytes (see ``serve_requests``).

    It receives ``order``, sends ``ready``, and writes its standard error to the empty file ``errors``.
    """

    def __init__(self, module: str, order: object, environ: Mapping[str, str], errors: IO[bytes], folder: Path) -> None:
        self._errors = errors
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=dict(environ),
            cwd=folder,
        )
        self._stdin, self._stdout = cast(IO[bytes], self._process.stdin), cast(IO[bytes], self._process.stdout)
        self.is_ready = False
        with contextlib.suppress(OSError):
            self._send(order)
            self.is_ready = self._stdout.read(len(_READY)) == _READY

    def ask(self, request: object, count: int) -> bytes:
        """Return the next ``count`` bytes of a worker's answer, or fewer bytes if the worker process died."""
        with contextlib.suppress(OSError):
            self._send(request)
            return self._stdout.read(count)
        return b""

    def last_line(self) -> str:
        """Return the last line on the worker's standard error, or the worker's exit status if there is no line."""
        self._errors.seek(0)
        lines = [line for line in self._errors.read().decode(errors="replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else f"exit status {self._process.poll()}"

    def close(self) -> None:
        """End the child process: close its pipes, and kill the process if it keeps running."""
        for stream in (self._stdin, self._stdout):
            with contextlib.suppress(OSError):
                stream.close()
        try:
            self._process.wait(_WORKER_PATIENCE_S if self.is_ready else 2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _send(self, value: object) -> None:
        pickle.dump(value, self._stdin)
        self._stdin.flush()


def serve_requests(prepare: Callable[[_Order], AbstractContextManager[Callable[[_Request], bytes]]]) -> None:
    """Answer requests from standard input until it ends; ``prepare`` yields the function that answers."""
    source, target = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # Libraries must print to standard error, because standard output carries the answers to requests.
    with prepare(pickle.load(source)) as answer:
        target.write(_READY)
        target.flush()
        while True:
            try:
                request = pickle.load(source)
            except EOFError:
                return
            target.write(answer(request))
            target.flush()


# --- one call ---


def call_limited(function: Callable[..., _T], *arguments: object, key: str, seconds: int, gib: int) -> _T:
    """Return ``function(*arguments)``, computed in a child process with limited CPU time and memory.

    An exception of the function is raised here. If the child dies, for example at a limit, raise RunDirectoryError.
    """
    request = pickle.dumps(sys.path) + pickle.dumps((seconds, gib, function, arguments))
    # With -P, the child process imports nothing from the current folder, which can be foreign.
    command = [sys.executable, "-P", "-c", f"{_SET_PATH}; from {__name__} import answer_call; answer_call()"]
    child = subprocess.run(command, input=request, capture_output=True, env=own_environ(), check=False)
    if child.returncode == -signal.SIGINT:
        raise Interrupted
    if child.returncode or not child.stdout:
        slow = child.returncode in (-signal.SIGXCPU, -signal.SIGALRM)
        how = (
            f"took more than {seconds} s of CPU time, or slept"
            if slow
            else f"ended early, with status {child.returncode}"
        )
        expected = f"one that needs less than {seconds} s and {gib} GiB, and code that does not end its process"
        raise RunDirectoryError(f"the process that tried this file or config {how}", key=key, expected=expected)
    result: _T | Exception = pickle.loads(child.stdout)
    if isinstance(result, Exception):
        raise result
    return result


def answer_call() -> None:
    """Call the function in the request of ``call_limited``, and write its result or exception to standard output."""
    import resource

    prepare_threads()
    target = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # Libraries must print to standard error, because standard output carries the result.
    seconds, gib, function, arguments = pickle.load(sys.stdin.buffer)
    signal.alarm(10 + 4 * seconds)  # Code can sleep; a busy machine can be slow.
    memory = (used_memory("VmData") or 0) + (gib << 30)
    for kind, limit in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_DATA, memory)):
        with contextlib.suppress(ValueError):  # The hard limit of this process is lower.
            resource.setrlimit(kind, (limit, resource.getrlimit(kind)[1]))
    try:
        result = function(*arguments)
    except Exception as error:
        result = error
    target.write(pickle.dumps(result))


# --- another program ---


@contextmanager
def running_program(
    command: Sequence[str], output: IO[bytes], environ: Mapping[str, str], folder: str
) -> Iterator[subprocess.Popen[bytes]]:
    """Start and yield a program in its own session; on exit, end the program and all processes that it has started."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        env=dict(environ),
        cwd=folder,
        start_new_session=True,  # A program in its own session does not receive Ctrl-C from the terminal.
    )
    try:
        yield process
    finally:
        end_program(process)


def end_program(process: subprocess.Popen[bytes]) -> None:
    """End a program that runs in its own session, and all processes that the program has started."""
    for number in (signal.SIGTERM, _KILL):
        _signal_group(process, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PROGRAM_PATIENCE_S)
            break
    _signal_group(process, _KILL)  # Processes that the program started can run longer than the program itself.


def _signal_group(process: subprocess.Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, number)
        else:
            process.terminate()
