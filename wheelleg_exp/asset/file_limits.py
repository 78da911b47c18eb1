"""Limits on what a robot's files may contain, name, and allocate. A larger file is not a robot.

`bounded_memory` also limits the memory of a whole conversion, because a damaged file can claim any size.
"""

from __future__ import annotations

import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from wheelleg_exp.errors import AssetError
from wheelleg_exp.machine import require_room, used_memory

LARGEST_FILE = 2**30  # bytes
LARGEST_TEXT = 2**28  # bytes of a file that is read whole, and grows twentyfold on the way: a URDF, a mesh
FARTHEST = 1e9  # m; MuJoCo refuses states beyond 1e10, and nothing of a robot is that far
MOST_PRIMS = 300_000
MOST_ELEMENTS = 200_000  # of XML
MOST_BODIES = 5_000
MOST_SHAPES = 20_000
POINT_BYTES = (
    2_100  # peak memory for each point and triangle of a mesh (measured: 1.5 to 2.06 kB, most of it in MuJoCo)
)
MOST_POINTS = 3_500_000  # points and triangles of all meshes as they are drawn, those of instances again: 7.4 GB


def require_size(
    count: int, most: int, what: str, *, key: str | None = None, where: str | None = None, expected: str = "one robot"
) -> None:
    """Refuse a robot that is too large.

    Raises:
        AssetError: ``count`` is above ``most``.
    """
    if count > most:
        raise AssetError(f"there are more than {most:,} {what}", key=key, where=where, expected=expected)


def require_near(lengths: ArrayLike, *, key: str, where: str | None = None) -> None:
    """Refuse lengths (m) that no robot has.

    Raises:
        AssetError: one is beyond ``FARTHEST``, or not a number.
    """
    largest = float(np.abs(np.asarray(lengths, dtype=float)).max(initial=0.0))
    if not largest <= FARTHEST:
        raise AssetError(f"it reaches {largest:.3g} m", key=key, where=where, expected=f"less than {FARTHEST:g} m")


TEXTURES = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tga", ".tif", ".tiff", ".bmp", ".dds", ".webp", ".tx")
LOOKS = (*TEXTURES, ".mdl", ".mtlx")
MESHES = (".stl", ".obj", ".dae", ".ply", ".glb", ".gltf", ".fbx")


POINTER = b"version https://git-lfs"  # how a file begins that Git LFS has not fetched
FETCH = "a pointer of Git LFS, not the file itself: 'git lfs pull' fetches that"


def require_plain_file(
    path: Path, expected: str, largest: int = LARGEST_FILE, *, key: str | None = None, where: str | None = None
) -> None:
    """Refuse what cannot be read as a file: a pipe or a device would be waited for, or never end.

    Args:
        path: the file.
        expected: what it has to be.
        largest: its size in bytes.
        key: what names it, a prim or an element.
        where: the file that names it.

    Raises:
        AssetError: there is nothing, a folder, a pipe, a device, or a file of more than ``largest`` bytes.
    """
    problem = _problem_of(path, largest)
    if problem:
        raise AssetError(problem, key=key, where=where, expected=expected)


def _problem_of(path: Path, largest: int) -> str:
    try:
        found = path.stat()
        str(path).encode()
    except FileNotFoundError:
        return f"there is no file '{path}'"
    except (OSError, ValueError) as error:
        return f"'{path}' cannot be read: {getattr(error, 'strerror', None) or error}"
    if stat.S_ISDIR(found.st_mode):
        return f"'{path}' is a folder"
    if not stat.S_ISREG(found.st_mode):
        return f"'{path}' is a pipe or a device"
    return f"'{path}' is larger than {largest >> 20} MB" if found.st_size > largest else ""


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
