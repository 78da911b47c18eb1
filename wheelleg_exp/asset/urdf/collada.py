"""Reads triangles from COLLADA files, the usual form of visuals in ROS: shapes and their places, no materials.

The file's unit of length counts and its ``up_axis`` does not, as in RViz and Gazebo: exporters set it at random.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.asset.geometry import Array, apply
from wheelleg_exp.asset.sources import MOST_POINTS
from wheelleg_exp.asset.urdf.xml import Element, parse_xml
from wheelleg_exp.asset.usd.shapes.gprims import triangles
from wheelleg_exp.errors import AssetError

Faces = NDArray[np.int64]

FACES = ("triangles", "polylist", "polygons", "trifans", "tristrips")
MOST_PARTS = 500_000  # of all nodes of one file; those that stand for each other can multiply without end


def read_dae(data: bytes) -> tuple[Array, Faces]:
    """Return vertices (n, 3) in m and faces (k, 3) of all shapes that the file's scene shows.

    Raises:
        ValueError: it is no COLLADA, or refers to what is not there.
    """
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
            raise ValueError(f"more than {MOST_POINTS:,} points and triangles")
        if len(part[1]):
            parts.append(part)
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]) * file.unit, np.concatenate(faces)


class _File:
    """A COLLADA document by ids."""

    def __init__(self, root: Element) -> None:
        self.root = root
        self._by_id = {e.attributes["id"]: e for e in root.walk() if "id" in e.attributes}
        asset = root.first("asset")
        unit = asset.first("unit") if asset else None
        self._parts = 0
        self.unit = float(unit.attributes.get("meter", "1")) if unit else 1.0

    def target(self, element: Element, name: str) -> Element:
        """Return what a reference such as ``#mesh-1`` names."""
        wanted = element.attributes.get(name, "")
        if wanted.removeprefix("#") not in self._by_id:
            raise ValueError(f"<{element.tag}> refers to '{wanted[:60]}', which is not in it")
        return self._by_id[wanted.removeprefix("#")]

    def shown(self) -> list[tuple[Element, Array]]:
        """Return the meshes of the scene with their 4x4 matrices."""
        scene = self.root.first("scene")
        instance = scene.first("instance_visual_scene") if scene else None
        visual = self.target(instance, "url") if instance else None
        if visual is None:
            meshes = [element.first("mesh") for element in self.root.walk() if element.tag == "geometry"]
            return [(mesh, np.eye(4)) for mesh in meshes if mesh]
        return [item for node in visual.all("node") for item in self._below(node, np.eye(4), 0)]

    def _below(self, node: Element, above: Array, depth: int) -> Iterator[tuple[Element, Array]]:
        self._parts += 1 + len(node.children)
        if depth > 50 or self._parts > MOST_PARTS:
            raise ValueError("nodes that refer to each other in a ring, or multiply")
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
    """Return the 4x4 matrix of one transformation of a node, identity for anything else."""
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
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        angle = math.radians(degrees)
        out[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return out


def _placed(file: _File, mesh: Element, matrix: Array) -> tuple[Array, Faces]:
    """Return a mesh's vertices and triangles in the scene; a mirrored one is turned inside out again."""
    groups = [child for child in mesh.children if child.tag in FACES]
    vertices = mesh.first("vertices")
    if vertices is None or not groups:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    points = apply(matrix, _positions(file, vertices))
    faces = np.concatenate([_faces(group) for group in groups])
    return points, faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def _positions(file: _File, vertices: Element) -> Array:
    position = next((e for e in vertices.all("input") if e.attributes.get("semantic") == "POSITION"), None)
    if position is None:
        raise ValueError("vertices without positions")
    source = file.target(position, "source")
    array = source.first("float_array")
    technique = source.first("technique_common")
    accessor = technique.first("accessor") if technique else None
    stride = int(accessor.attributes.get("stride", "3")) if accessor else 3
    if array is None or stride < 3:
        raise ValueError("vertices without positions")
    return _numbers(array).reshape(-1, stride)[:, :3]


def _faces(group: Element) -> Faces:
    inputs = group.all("input")
    offset = next((int(i.attributes["offset"]) for i in inputs if i.attributes.get("semantic") == "VERTEX"), 0)
    stride = 1 + max((int(item.attributes.get("offset", "0")) for item in inputs), default=0)
    lists = [np.array(p.text.split(), dtype=np.int64)[offset::stride] for p in group.all("p")]
    if group.tag == "triangles":
        return _joined([corners.reshape(-1, 3) for corners in lists])
    if group.tag == "polylist":
        counts = group.first("vcount")
        sizes = np.array(counts.text.split() if counts else [], dtype=int)
        if any((sizes < 0).any() or (sizes > len(corners)).any() or sizes.sum() > len(corners) for corners in lists):
            raise ValueError("its polygons do not fit its corners")
        return _joined([triangles(sizes, corners) for corners in lists])
    if group.tag == "tristrips":
        return _joined([_strip(corners) for corners in lists])
    return _joined([triangles(np.array([len(corners)]), corners) for corners in lists])


def _strip(corners: Faces) -> Faces:
    """Return the triangles of a strip, every second one turned round."""
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    return faces


def _joined(parts: list[Faces]) -> Faces:
    return np.concatenate(parts) if parts else np.zeros((0, 3), dtype=np.int64)
