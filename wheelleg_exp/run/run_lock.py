"""Lock a run directory so that only one process writes to it, and detect whether a run's process has ended."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import time
from pathlib import Path
from typing import TypedDict

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import file_error, read_json

_PROC = Path("/proc")


class ProcessId(TypedDict, total=False):
    """The identity of a process: pid, host, boot id, and its start in clock ticks.

    A new process can have the pid of an ended one, but not its boot id and start, which are None if they are unknown.
    """

    pid: int | None
    host: str | None
    boot_id: str | None
    start_ticks: int | None


def this_process() -> ProcessId:
    """Return the identity of this process."""
    pid = os.getpid()
    return {"pid": pid, "host": platform.node(), "boot_id": _boot_id(), "start_ticks": _start_ticks(pid)}


def is_alive(recorded: ProcessId | None) -> bool | None:
    """Return whether a process that ``this_process`` recorded still runs; None if the process is on another host."""
    pid = recorded and recorded.get("pid")
    if not recorded or not isinstance(pid, int) or pid <= 0 or recorded.get("host") != platform.node():
        return None
    if recorded.get("boot_id") != _boot_id():
        return False
    if (_PROC / "self" / "stat").exists():
        ticks = _start_ticks(pid)
        return ticks is not None and ticks == recorded.get("start_ticks", ticks)
    try:
        os.kill(pid, 0)  # Signal 0 only tests whether the process exists.
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _boot_id() -> str | None:
    try:
        return (_PROC / "sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return None


def _start_ticks(pid: int) -> int | None:
    """Return the start time of a process from ``/proc/<pid>/stat``; None for a missing process or a zombie process."""
    try:
        text = (_PROC / str(pid) / "stat").read_text(errors="replace")
    except OSError:
        return None
    # In /proc/<pid>/stat, the program name can contain spaces and ')', so count the fields after the last ')'.
    fields = text.rpartition(")")[2].split()
    return None if fields[0] in "ZX" else int(fields[19])


RUN_LOCK, MANIFEST_LOCK = ".lock", ".manifest.lock"


class RunLock:
    """Lock a run directory for writing, as a context manager, which acquires the lock unless this object has it.

    The kernel releases the lock (``flock``) when the process ends. ``timeout_s`` limits the wait for another process.
    """

    def __init__(self, directory: os.PathLike[str], *, name: str = RUN_LOCK, timeout_s: float = 0.0) -> None:
        self.path = Path(directory) / name
        self.timeout_s = timeout_s
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Acquire the lock; if a different process has the lock, raise RunDirectoryError with that process's pid."""
        deadline = time.monotonic() + self.timeout_s
        while not self._try():
            if time.monotonic() >= deadline:
                who = "another process"
                with contextlib.suppress(RunDirectoryError, LookupError, TypeError):
                    holder = read_json(self.path)
                    who = f"process {holder['pid']} on {holder['host']}"
                message = f"'{self.path.parent}' is being written by {who}"
                raise RunDirectoryError(message, expected="one writer at a time: wait for that process, or end it")
            time.sleep(0.02)

    def release(self) -> None:
        """Release the lock; do nothing if this object has not acquired the lock."""
        if self._descriptor is None:
            return
        # Do not delete the lock file; otherwise two processes could lock two different files of the same name.
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)
        self._descriptor = None

    def __enter__(self) -> RunLock:
        if self._descriptor is None:
            self.acquire()
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def _try(self) -> bool:
        try:
            # O_NOFOLLOW refuses a symbolic link as lock file, because ``ftruncate`` would empty the link's target.
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.ftruncate(descriptor, 0)
                os.write(descriptor, json.dumps(this_process()).encode())
            except BaseException as error:
                os.close(descriptor)
                if isinstance(error, BlockingIOError):
                    return False
                raise
        except OSError as error:
            raise file_error(self.path, error) from error
        self._descriptor = descriptor
        return True
