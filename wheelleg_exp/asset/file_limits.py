"""Limit the size of robot files, the number of their references, and the memory of their conversion."""

from __future__ import annotations

import re
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
LARGEST_TEXT = 2**28  # bytes, URDF or mesh
FARTHEST = 1e9  # m
MOST_PRIMS = 300_000
MOST_ELEMENTS = 200_000  # XML elements
MOST_BODIES = 5_000
MOST_SHAPES = 20_000
POINT_BYTES = 2_100  # bytes, measured
MOST_POINTS = 3_500_000  # they need 7.4 GB


def require_size(
    count: int, most: int, what: str, *, key: str | None = None, where: str | None = None, expected: str = "one robot"
) -> None:
    """Raise an AssetError if ``count``, such as a robot's number of bodies, exceeds ``most``."""
    if count > most:
        raise AssetError(f"the robot has more than {most:,} {what}", key=key, where=where, expected=expected)


def require_near(lengths: ArrayLike, *, key: str, where: str | None = None) -> None:
    """Raise an AssetError if a position or size in ``lengths`` exceeds 1e9 m."""
    largest = float(np.abs(np.asarray(lengths, dtype=float)).max(initial=0.0))
    if not largest <= FARTHEST:
        message = f"the position or size reaches {largest:.3g} m"
        raise AssetError(message, key=key, where=where, expected=f"less than {FARTHEST:g} m")


TEXTURES = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tga", ".tif", ".tiff", ".bmp", ".dds", ".webp", ".tx")
LOOKS = (*TEXTURES, ".mdl", ".mtlx")
MESHES = (".stl", ".obj", ".dae", ".ply", ".glb", ".gltf", ".fbx")


_POINTER = b"version https://git-lfs"
_PAGE = re.compile(rb"(\xef\xbb\xbf)?(\s|<\?.*?\?>|<!--.*?-->)*+<(!doctype\s+)?html\b", re.IGNORECASE | re.DOTALL)


def wrong_content(start: bytes) -> str:
    """Return what a file with these first bytes is in place of the wanted file; an empty text if nothing is known."""
    if start.startswith(_POINTER):
        return "a Git LFS pointer, not the file itself: 'git lfs pull' fetches the file"
    return "a web page (HTML), not the file itself: download the raw file" if _PAGE.match(start[:1000]) else ""


def require_plain_file(path: Path, expected: str, largest: int = LARGEST_FILE, *, where: str | None = None) -> None:
    """Raise an AssetError for a path that is not a readable file: reading a pipe or a device could wait forever.

    ``expected`` is the error message's description of a valid file, such as ``a layer of USD``. ``where`` is the file
    that refers to ``path``. Without ``where``, a web page or a Git LFS pointer in place of the file is an error, too.
    """
    problem = _problem_of(path, largest, where is None)
    if problem:
        raise AssetError(problem, where=where, expected=expected)


def _problem_of(path: Path, largest: int, check_content: bool) -> str:
    content = ""
    try:
        found = path.stat()
        str(path).encode()
        if check_content and stat.S_ISREG(found.st_mode):
            with path.open("rb") as file:
                content = wrong_content(file.read(1000))
    except FileNotFoundError:
        return f"there is no file '{path}'"
    except (OSError, ValueError) as error:
        return f"'{path}' cannot be read: {getattr(error, 'strerror', None) or error}"
    if stat.S_ISDIR(found.st_mode):
        return f"'{path}' is a folder"
    if not stat.S_ISREG(found.st_mode):
        return f"'{path}' is a pipe or a device"
    if content:
        return f"'{path}' is {content}"
    return f"'{path}' is larger than {largest >> 20} MB" if found.st_size > largest else ""


MOST = 2**33  # bytes

_lock = threading.Lock()
_open: list[tuple[int, int]] = []  # limits before each conversion


@contextmanager
def bounded_memory(source: Path, most: int = 0) -> Iterator[None]:
    """On Linux, limit this process to ``most`` bytes (default: 8 GiB) more memory than it uses at the time of the call.

    A tiny damaged USD crate file can declare a huge array, which the USD library allocates before it checks the file.
    """
    require_room()
    with _lock:
        used = used_memory("VmData")
        if used is not None:
            import resource

            soft, hard = _open[0] if _open else resource.getrlimit(resource.RLIMIT_DATA)
            _open.append((soft, hard))
            bounds = [used + (most or MOST), *(limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY)]
            resource.setrlimit(resource.RLIMIT_DATA, (min(bounds), hard))
    try:
        yield
    except MemoryError:
        message = f"'{source.name}' needs more than {(most or MOST) >> 30} GB of memory"
        raise AssetError(message, where=str(source), expected="one robot, whole") from None
    finally:
        with _lock:
            if _open:
                import resource

                limit = _open.pop()
                if not _open:
                    resource.setrlimit(resource.RLIMIT_DATA, limit)
