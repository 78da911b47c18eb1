"""Bounds the memory that a conversion may take, whatever a damaged file claims to hold."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wheelleg_exp.errors import AssetError
from wheelleg_exp.memory import require_room, used_memory

MOST = 2**33  # bytes beyond what the process has

_lock = threading.Lock()
_open: list[tuple[int, int]] = []  # the process's own limit, once for each conversion under way


@contextmanager
def bounded_memory(source: Path) -> Iterator[None]:
    """Let allocations fail that go 8 GiB beyond what the process has at the start; on Linux, elsewhere nothing.

    A crate of a few bytes can claim two thousand million numbers, and the USD library makes room for them before it
    looks. The limit is the process's, so other threads share it meanwhile.

    Raises:
        AssetError: the memory was not enough.
        WheellegError: the limits of the process leave too little memory to start.
    """
    require_room()
    _enter()
    try:
        yield
    except MemoryError:
        message = f"'{source.name}' needs more than {MOST >> 30} GB of memory"
        raise AssetError(message, where=str(source), expected="one robot, whole") from None
    finally:
        _leave()


def _enter() -> None:
    with _lock:
        used = used_memory("VmData")
        if used is None:
            return
        import resource

        soft, hard = _open[0] if _open else resource.getrlimit(resource.RLIMIT_DATA)
        _open.append((soft, hard))
        bounds = [used + MOST, *(limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY)]
        resource.setrlimit(resource.RLIMIT_DATA, (min(bounds), hard))


def _leave() -> None:
    with _lock:
        if _open:
            import resource

            limit = _open.pop()
            if not _open:
                resource.setrlimit(resource.RLIMIT_DATA, limit)
