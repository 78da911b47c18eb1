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
LARGEST_TEXT = 2**28  # bytes of a URDF or mesh, which is read at once and grows twentyfold in memory
FARTHEST = 1e9  # m; MuJoCo refuses states beyond 1e10
MOST_PRIMS = 300_000
MOST_ELEMENTS = 200_000  # XML elements
MOST_BODIES = 5_000
MOST_SHAPES = 20_000
POINT_BYTES = 2_100  # peak memory per point and triangle of a mesh (measured: 1.5 to 2.06 kB, mostly in MuJoCo)
MOST_POINTS = 3_500_000  # points and triangles of all meshes, counted once per instance: 7.4 GB


def require_size(
    count: int, most: int, what: str, *, key: str | None = None, where: str | None = None, expected: str = "one robot"
) -> None:
    """Raise an error if a robot is too large.

    Raises:
        AssetError: ``count`` is above ``most``.
    """
    if count > most:
        raise AssetError(f"there are more than {most:,} {what}", key=key, where=where, expected=expected)


def require_near(lengths: ArrayLike, *, key: str, where: str | None = None) -> None:
    """Raise an error for lengths (m) that no robot has.

    Raises:
        AssetError: a length is beyond ``FARTHEST``, or NaN.
    """
    largest = float(np.abs(np.asarray(lengths, dtype=float)).max(initial=0.0))
    if not largest <= FARTHEST:
        raise AssetError(f"it reaches {largest:.3g} m", key=key, where=where, expected=f"less than {FARTHEST:g} m")


TEXTURES = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tga", ".tif", ".tiff", ".bmp", ".dds", ".webp", ".tx")
LOOKS = (*TEXTURES, ".mdl", ".mtlx")
MESHES = (".stl", ".obj", ".dae", ".ply", ".glb", ".gltf", ".fbx")


POINTER = b"version https://git-lfs"  # first bytes of a file that Git LFS has not fetched
FETCH = "a Git LFS pointer, not the file itself: 'git lfs pull' fetches the file"


def require_plain_file(
    path: Path, expected: str, largest: int = LARGEST_FILE, *, key: str | None = None, where: str | None = None
) -> None:
    """Raise an error for a path that is not a readable file: reading a pipe or a device could wait forever.

    ``expected`` describes the file in the message, ``key`` is the prim or element that names it, and ``where`` is the
    file that contains this prim or element.

    Raises:
        AssetError: the path is missing, a folder, a pipe, a device, or larger than ``largest`` bytes.
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


MOST = 2**33  # bytes beyond the process's current memory

_lock = threading.Lock()
_open: list[tuple[int, int]] = []  # the process's own limit, once for each running conversion


@contextmanager
def bounded_memory(source: Path) -> Iterator[None]:
    """Limit allocations to 8 GiB beyond the process's current memory; on Linux only.

    A damaged crate of a few bytes can claim two thousand million numbers, and the USD library allocates them before it
    checks. The limit applies to the whole process, so other threads share it.

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
