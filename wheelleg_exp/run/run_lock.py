"""Lock a run directory so that one process writes it at a time, and detect whether a recorded process still runs."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import file_error, read_json

_PROC = Path("/proc")


def this_process() -> dict[str, Any]:
    """Return what identifies this process: pid, host, boot id, and its start in clock ticks.

    A later process can have the same pid, but not the same boot and start. The last two are None on systems that do not
    report them.
    """
    pid = os.getpid()
    return {"pid": pid, "host": platform.node(), "boot_id": _boot_id(), "start_ticks": _start_ticks(pid)}


def is_alive(recorded: Mapping[str, Any]) -> bool | None:
    """Return whether a process described by ``this_process`` still runs; None when unknown.

    It is unknown on another host, and on systems that do not show processes.
    """
    pid = recorded.get("pid")
    if not isinstance(pid, int) or pid <= 0 or recorded.get("host") != platform.node():
        return None
    if recorded.get("boot_id") != _boot_id():
        return False
    if (_PROC / "self" / "stat").exists():
        ticks = _start_ticks(pid)
        return ticks is not None and ticks == recorded.get("start_ticks", ticks)
    return _answers_signal(pid)


def _answers_signal(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _boot_id() -> str | None:
    try:
        return (_PROC / "sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return None


def _start_ticks(pid: int) -> int | None:
    """Return field 22 of ``/proc/<pid>/stat``; None when the process does not exist or is a zombie."""
    try:
        text = (_PROC / str(pid) / "stat").read_text(errors="replace")
    except OSError:
        return None
    # The name in parentheses can contain anything, so fields are counted from the last parenthesis (proc(5)).
    fields = text.rpartition(")")[2].split()
    return None if fields[0] in "ZX" else int(fields[19])


RUN_LOCK = ".lock"
MANIFEST_LOCK = ".manifest.lock"


class RunLock:
    """Lock a run directory for writing, as a context manager.

    The kernel releases the lock (``flock``) when the process ends, so a killed process leaves no lock.

    Args:
        directory: the run directory.
        name: the lock file's name; a run and its manifest have one each.
        timeout_s: seconds to wait while another process has the lock.
    """

    def __init__(self, directory: os.PathLike[str], *, name: str = RUN_LOCK, timeout_s: float = 0.0) -> None:
        self.path = Path(directory) / name
        self.timeout_s = timeout_s
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Take the lock.

        Raises:
            RunDirectoryError: another process has the lock (the error names its pid), or the file cannot be created.
        """
        if self._descriptor is not None:
            raise RuntimeError("this lock is already held")
        deadline = time.monotonic() + self.timeout_s
        while not self._try():
            if time.monotonic() >= deadline:
                raise self._held_by_another()
            time.sleep(0.02)

    def release(self) -> None:
        """Release the lock; do nothing if it is not acquired."""
        if self._descriptor is None:
            return
        # The file stays: if it was unlinked, two processes could lock two files of one name.
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)
        self._descriptor = None

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep the lock while the body runs, and release it afterwards, even if it was acquired before."""
        if self._descriptor is None:
            self.acquire()
        try:
            yield
        finally:
            self.release()

    def __enter__(self) -> RunLock:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def _try(self) -> bool:
        try:
            descriptor = self._open_and_flock()
            if descriptor is None:
                return False
            os.ftruncate(descriptor, 0)
            os.write(descriptor, json.dumps(this_process()).encode())
        except OSError as error:
            raise file_error(self.path, error) from error
        self._descriptor = descriptor
        return True

    def _open_and_flock(self) -> int | None:
        # O_NOFOLLOW, because the target of a link would be truncated.
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor

    def _holder(self) -> dict[str, Any]:
        with contextlib.suppress(RunDirectoryError):
            holder = read_json(self.path)
            if isinstance(holder, dict):
                return holder
        return {}

    def _held_by_another(self) -> RunDirectoryError:
        holder = self._holder()
        who = f"process {holder['pid']} on {holder.get('host')}" if "pid" in holder else "another process"
        return RunDirectoryError(
            f"'{self.path.parent}' is being written by {who}",
            expected="one writer at a time: wait for that process, or end it",
        )
