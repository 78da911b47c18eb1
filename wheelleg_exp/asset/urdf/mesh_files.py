"""Find the mesh files that a URDF names, without a ROS installation, and read triangles from STL, OBJ, and COLLADA.

COLLADA's unit of length counts and its ``up_axis`` does not, as in RViz and Gazebo: exporters set it at random.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.asset.file_limits import LARGEST_TEXT, MOST_POINTS, require_plain_file, wrong_content
from wheelleg_exp.asset.rigid_geometry import Array, apply, turned
from wheelleg_exp.asset.urdf.urdf_document import PACKAGE, Document, Element, parse_xml
from wheelleg_exp.asset.usd.gprims import triangles
from wheelleg_exp.asset.usd.usd_stage import file_hash, relative_name
from wheelleg_exp.errors import AssetError

Faces = NDArray[np.int64]
Triangles = tuple[Array, Faces]
"""Vertices (n, 3) and faces (k, 3) of indices."""

FACES = ("triangles", "polylist", "polygons", "trifans", "tristrips")
MOST_PARTS = 500_000  # nodes of one file
_NOTHING: Triangles = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)


def read_dae(data: bytes) -> Triangles:
    """Return vertices (n, 3) in m and faces (k, 3) of all shapes in the scene of a COLLADA file."""
    try:
        root = parse_xml(Path("mesh"), data)
    except AssetError as error:
        raise ValueError(error.message) from None
    file = _File(root)
    parts, count = [], 0
    for mesh, matrix in file.shown():
        part = _placed(file, mesh, matrix)
        count += len(part[0]) + len(part[1])
        if count > MOST_POINTS:
            raise ValueError(f"the COLLADA scene has more than {MOST_POINTS:,} points and triangles")
        if len(part[1]):
            parts.append(part)
    if not parts:
        return _NOTHING
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]) * file.unit, np.concatenate(faces)


class _File:
    def __init__(self, root: Element) -> None:
        self.root = root
        self._by_id = {e.attributes["id"]: e for e in root.walk() if "id" in e.attributes}
        unit = root.first("asset", "unit")
        self._parts = 0
        self.unit = float(unit.attributes.get("meter", "1")) if unit else 1.0

    def target(self, element: Element, name: str) -> Element:
        wanted = element.attributes.get(name, "")
        if wanted.removeprefix("#") not in self._by_id:
            raise ValueError(f"<{element.tag}> refers to '{wanted[:60]}', but the file has no such element")
        return self._by_id[wanted.removeprefix("#")]

    def shown(self) -> list[tuple[Element, Array]]:
        instance = self.root.first("scene", "instance_visual_scene")
        visual = self.target(instance, "url") if instance else None
        if visual is None:
            meshes = [element.first("mesh") for element in self.root.walk() if element.tag == "geometry"]
            return [(mesh, np.eye(4)) for mesh in meshes if mesh]
        return [item for node in visual.all("node") for item in self._below(node, np.eye(4), 0)]

    def _below(self, node: Element, above: Array, depth: int) -> Iterator[tuple[Element, Array]]:
        # Limit the number of nodes, because a COLLADA file of a few lines can repeat its nodes millions of times.
        self._parts += 1 + len(node.children)
        if depth > 50 or self._parts > MOST_PARTS:
            raise ValueError("the COLLADA file's nodes refer to each other in a cycle, or describe too many shapes")
        matrix = above
        for child in node.children:
            matrix = matrix @ _transform(child)
        for child in node.children:
            if child.tag == "instance_geometry":
                mesh = self.target(child, "url").first("mesh")
                if mesh is not None:
                    yield mesh, matrix
            elif child.tag == "node":
                yield from self._below(child, matrix, depth + 1)
            elif child.tag == "instance_node":
                yield from self._below(self.target(child, "url"), matrix, depth + 1)


def _numbers(element: Element) -> Array:
    return np.array(element.text.split(), dtype=float)


def _transform(element: Element) -> Array:
    out = np.eye(4)
    if element.tag == "matrix":
        return _numbers(element).reshape(4, 4)
    if element.tag == "translate":
        out[:3, 3] = _numbers(element)
    elif element.tag == "scale":
        out[:3, :3] = np.diag(_numbers(element))
    elif element.tag == "rotate":
        x, y, z, degrees = _numbers(element)
        axis = np.array([x, y, z]) / (math.hypot(x, y, z) or 1.0)
        out[:3, :3] = turned(axis, math.radians(degrees))
    return out


def _placed(file: _File, mesh: Element, matrix: Array) -> Triangles:
    groups = [child for child in mesh.children if child.tag in FACES]
    vertices = mesh.first("vertices")
    if vertices is None or not groups:
        return _NOTHING
    position = next((e for e in vertices.all("input") if e.attributes.get("semantic") == "POSITION"), None)
    if position is None:
        raise ValueError("vertices without positions")
    source = file.target(position, "source")
    array = source.first("float_array")
    accessor = source.first("technique_common", "accessor")
    stride = int(accessor.attributes.get("stride", "3")) if accessor else 3
    if array is None or stride < 3:
        raise ValueError("vertices without positions")
    points = apply(matrix, _numbers(array).reshape(-1, stride)[:, :3])
    faces = np.concatenate([_faces(group) for group in groups])
    return points, faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def _faces(group: Element) -> Faces:
    inputs = group.all("input")
    offset = next((int(i.attributes["offset"]) for i in inputs if i.attributes.get("semantic") == "VERTEX"), 0)
    stride = 1 + max((int(item.attributes.get("offset", "0")) for item in inputs), default=0)
    lists = [np.array(p.text.split(), dtype=np.int64)[offset::stride] for p in group.all("p")]
    if group.tag == "triangles":
        parts = [corners.reshape(-1, 3) for corners in lists]
    elif group.tag == "polylist":
        counts = group.first("vcount")
        sizes = np.array(counts.text.split() if counts else [], dtype=int)
        if any((sizes < 0).any() or (sizes > len(corners)).any() or sizes.sum() > len(corners) for corners in lists):
            raise ValueError("the sizes of a mesh's polygons do not match the number of polygon corners")
        parts = [triangles(sizes, corners) for corners in lists]
    elif group.tag == "tristrips":
        parts = [np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1) for corners in lists]
        for faces in parts:
            faces[1::2] = faces[1::2, ::-1]
    else:
        parts = [triangles(np.array([len(corners)]), corners) for corners in lists]
    return np.concatenate([np.zeros((0, 3), dtype=np.int64), *parts])


_STL_HEAD, _STL_FACE = 84, 50  # bytes


def read_mesh(path: Path) -> Triangles:
    """Return the triangles of a mesh file, in the units and axes of the file."""
    reader = reader_of(path.name)
    try:
        with np.errstate(all="ignore"):
            data = path.read_bytes()
            if problem := wrong_content(data):
                raise ValueError(problem)
            vertices, faces = reader(data)
    except OSError as error:
        raise ValueError(f"the mesh file cannot be read ({error.strerror})") from error
    except (ArithmeticError, LookupError, ValueError) as error:
        raise ValueError(f"the mesh file is damaged ({error})") from error
    if len(vertices) + len(faces) > MOST_POINTS:
        raise ValueError(f"the mesh file has more than {MOST_POINTS:,} points and triangles")
    if not len(faces) or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("the mesh file has no triangles, or a vertex that is missing or not finite")
    return vertices, faces


def reader_of(name: str) -> Callable[[bytes], Triangles]:
    """Return the function that reads a mesh file, by the file's suffix."""
    suffix = PurePosixPath(name).suffix
    if suffix.lower() not in READERS:
        raise ValueError(f"{suffix or 'a file without suffix'} is not a supported mesh format")
    return READERS[suffix.lower()]


def read_stl(data: bytes) -> Triangles:
    """Return the triangles of a binary or text STL file; equal corners become one vertex."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= _STL_HEAD + count * _STL_FACE:
        layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
        corners = np.frombuffer(data, layout, count, _STL_HEAD)["corners"].astype(float).reshape(-1, 3)
    elif data.lstrip()[:5].lower() == b"solid":
        words = data.decode("utf-8", "replace").split()
        starts = [place for place, word in enumerate(words) if word == "vertex"]
        corners = np.array([words[place + 1 : place + 4] for place in starts], dtype=float).reshape(-1, 3)
    else:
        corners = np.zeros((0, 3))
    if not len(corners):
        raise ValueError("the STL file is not a text file, and its length does not match its number of triangles")
    if len(corners) % 3:
        raise ValueError("a triangle of the STL file does not have three corners")
    # View each corner's bytes as one value, so that np.unique merges equal corners; adding 0.0 turns -0.0 into 0.0.
    keys = np.ascontiguousarray(corners + 0.0).view(np.dtype((np.void, corners.dtype.itemsize * 3))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[inverse].reshape(-1, 3).astype(np.int64)


def read_obj(data: bytes) -> Triangles:
    """Return the triangles of all objects in an OBJ file."""
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


LEVELS = 6  # searched parent folders
_SCHEME = re.compile(r"^([a-z][a-z0-9+.-]+):/{0,2}", re.IGNORECASE)


@dataclass
class Files:
    """The files of one URDF: sha256 of found files by relative path, and names of missing files."""

    document: Document
    hashes: dict[str, str] = field(default_factory=dict)
    missing: dict[str, None] = field(default_factory=dict)
    _found: dict[str, Path | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.folder = self.document.source.resolve().parent
        compiler = self.document.root.first("mujoco", "compiler")
        self.mesh_folder = self.document.text(compiler, "meshdir", "the search for mesh files") if compiler else None
        self._note(self.document.source)

    def find(self, name: str, endings: tuple[str, ...] = tuple(READERS)) -> Path | None:
        """Return the path of a mesh file, if it exists; a file with a suffix not in ``endings`` is never opened."""
        if not name.lower().endswith(endings):
            return None
        if name not in self._found:
            plain = PACKAGE.sub(r"package://\1/", name).replace("\\", "/")
            path = next((path for path in self._candidates(plain) if _readable(path)), None)
            self._found[name] = path
            if path is None:
                self.missing[name] = None
            else:
                self._note(path)
        return self._found[name]

    def _note(self, path: Path) -> None:
        require_plain_file(path, "a mesh or a texture", LARGEST_TEXT, where=str(self.document.source))
        try:
            self.hashes[relative_name(path, self.folder)] = file_hash(path)
        except OSError as error:
            message = f"'{path}' cannot be read: {error.strerror}"
            raise AssetError(message, where=str(self.document.source), expected="a mesh or a texture") from None

    def _candidates(self, name: str) -> Iterator[Path]:
        """Yield possible paths of a file: next to the URDF, in its package, or in a folder above both."""
        scheme = _SCHEME.match(name)
        if scheme is None:
            yield self.folder / name
            yield from self._moved(name)
            if self.mesh_folder is not None:
                yield self.folder / self.mesh_folder / name
                yield self.folder / self.mesh_folder / Path(name).name
            yield from (above / name for above in self._above())
        elif scheme.group(1).lower() == "file":
            # Try both spellings of a mesh file's name, because some tools write a space as %20.
            for path in dict.fromkeys((name[scheme.end() :], unquote(name[scheme.end() :]))):
                yield Path("/" + path.lstrip("/"))
                yield self.folder / path
                yield from self._moved("/" + path.lstrip("/"))
        elif scheme.group(1).lower() in ("package", "model"):
            yield from self._in_package(*name[scheme.end() :].partition("/")[::2])

    def _moved(self, name: str) -> Iterator[Path]:
        """Yield local paths of another machine's file: ``pkg/a.stl`` above the URDF for ``/opt/share/pkg/a.stl``."""
        parts = Path(name).parts if name.startswith("/") else ()
        around = {above.name for above in (self.folder, *self._above())}
        for index in range(1, len(parts) - 1):
            if parts[index - 1] == "share" or parts[index] in around:
                yield from self._in_package(parts[index], "/".join(parts[index + 1 :]))

    def _in_package(self, package: str, rest: str) -> Iterator[Path]:
        """Yield possible files of a package: in a folder of that name, or in a parent folder that is the package."""
        for above in (self.folder, *self._above()):
            if above.name == package:
                yield above / rest
            yield above / package / rest
        yield from (above / rest for above in (self.folder, *self._above()))

    def _above(self) -> list[Path]:
        return list(self.folder.parents)[:LEVELS]


def _readable(path: Path) -> bool:
    try:
        return path.is_file() and os.access(path, os.R_OK)
    except (OSError, ValueError):
        return False
