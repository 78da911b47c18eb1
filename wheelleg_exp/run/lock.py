"""One writer at a time for one run directory."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import file_error, read_json
from wheelleg_exp.run.process import this_process

RUN_LOCK = ".lock"
MANIFEST_LOCK = ".manifest.lock"


class RunLock:
    """Hold a run directory for writing, as a context manager.

    The kernel's lock (``flock``) goes with its process, so nothing is left behind by one that was killed.

    Args:
        directory: the run directory.
        name: the lock file's name; a run and its manifest have one each.
        timeout_s: seconds to wait for another holder.
    """

    def __init__(self, directory: os.PathLike[str], *, name: str = RUN_LOCK, timeout_s: float = 0.0) -> None:
        self.path = Path(directory) / name
        self.timeout_s = timeout_s
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Take the lock.

        Raises:
            RunDirectoryError: another process holds it (named by its pid), or the file cannot be made.
        """
        if self._descriptor is not None:
            raise RuntimeError("this lock is already held")
        deadline = time.monotonic() + self.timeout_s
        while not self._try():
            if time.monotonic() >= deadline:
                raise self._held_by_another()
            time.sleep(0.02)

    def release(self) -> None:
        """Give the lock back; nothing happens when it is not held."""
        if self._descriptor is None:
            return
        # The file stays: unlinking it would let two processes lock two files of one name.
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)
        self._descriptor = None

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold the lock while the body runs; one that was taken before is given back behind it as well."""
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
        # Never through a link: what it leads to would be emptied.
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
            expected="one writer at a time: wait for it, or end it first",
        )
