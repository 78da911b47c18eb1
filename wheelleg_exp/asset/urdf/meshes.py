"""Reads triangles from STL and OBJ files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.asset.geometry import Array
from wheelleg_exp.asset.sources import FETCH, MOST_POINTS, POINTER
from wheelleg_exp.asset.urdf.collada import read_dae
from wheelleg_exp.asset.usd.shapes.gprims import triangles

Triangles = tuple[Array, NDArray[np.int64]]
"""Vertices (n, 3) and faces (k, 3) of indices."""

_STL_HEAD, _STL_FACE = 84, 50  # bytes


def read_mesh(path: Path) -> Triangles:
    """Return a file's triangles, in its own units and axes.

    Raises:
        ValueError: the format is not known, or the file is damaged or too large; the text says which.
    """
    reader = reader_of(path.name)
    try:
        with np.errstate(all="ignore"):  # what is not finite is looked for below
            data = path.read_bytes()
            if data.startswith(POINTER):
                raise ValueError(FETCH)
            vertices, faces = reader(data)
    except OSError as error:
        raise ValueError(f"the file cannot be read ({error.strerror})") from error
    except (ArithmeticError, LookupError, ValueError) as error:
        raise ValueError(f"the file is damaged ({error})") from error
    if len(vertices) + len(faces) > MOST_POINTS:
        raise ValueError(f"it has more than {MOST_POINTS:,} points and triangles")
    if not len(faces) or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("the file holds no triangles, or points that are not finite")
    return vertices, faces


def reader_of(name: str) -> Callable[[bytes], Triangles]:
    """Return what reads a file, by its ending.

    Raises:
        ValueError: the format is not known.
    """
    suffix = PurePosixPath(name).suffix
    if suffix.lower() not in READERS:
        raise ValueError(f"{suffix or 'a file without ending'} is no mesh format that is read here")
    return READERS[suffix.lower()]


def read_stl(data: bytes) -> Triangles:
    """Return the triangles of a binary or textual STL; equal corners become one vertex."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= _STL_HEAD + count * _STL_FACE:  # in a text these four bytes are a number far too large
        layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
        corners = np.frombuffer(data, layout, count, _STL_HEAD)["corners"].astype(float).reshape(-1, 3)
    elif data.lstrip()[:5].lower() == b"solid":
        words = data.decode("utf-8", "replace").split()
        starts = [place for place, word in enumerate(words) if word == "vertex"]
        corners = np.array([words[place + 1 : place + 4] for place in starts], dtype=float).reshape(-1, 3)
    else:
        corners = np.zeros((0, 3))
    if not len(corners):
        raise ValueError("neither text nor as long as its number of triangles says")
    if len(corners) % 3:
        raise ValueError("a triangle with other than three corners")
    return _welded(corners)


def _welded(corners: Array) -> Triangles:
    """Return triangles from corners (3 k, 3), each point once, in the order of first use."""
    keys = np.ascontiguousarray(corners + 0.0).view(np.dtype((np.void, corners.dtype.itemsize * 3))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[inverse].reshape(-1, 3).astype(np.int64)


def read_obj(data: bytes) -> Triangles:
    """Return the triangles of an OBJ, all its objects together."""
    points: list[list[str]] = []
    corners: list[int] = []
    counts: list[int] = []
    for line in data.decode("utf-8", "replace").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            points.append(words[1:4])
        elif words[0] == "f":
            indices = [int(word.split("/", 1)[0]) for word in words[1:]]
            corners += [index - 1 if index > 0 else len(points) + index for index in indices]
            counts.append(len(indices))
    vertices = np.array(points, dtype=float).reshape(-1, 3)
    return vertices, triangles(np.array(counts, dtype=int), np.array(corners, dtype=int))


READERS: dict[str, Callable[[bytes], Triangles]] = {".stl": read_stl, ".obj": read_obj, ".dae": read_dae}
