"""Turns a URDF's visuals and colliders into geoms: primitives as MuJoCo reads them, meshes from their files."""

from __future__ import annotations

import hashlib
from pathlib import PurePosixPath

import numpy as np

from wheelleg_exp.asset.description import Geom, Mesh, ShapeKind
from wheelleg_exp.asset.geometry import Array, Frame
from wheelleg_exp.asset.naming import Numbered
from wheelleg_exp.asset.reader.shapes import SMALLEST_AREA, Shape, flat_to_box
from wheelleg_exp.asset.reader.urdf.document import Document
from wheelleg_exp.asset.reader.urdf.files import Files
from wheelleg_exp.asset.reader.urdf.kinematics import Link, Tree
from wheelleg_exp.asset.reader.urdf.looks import Looks
from wheelleg_exp.asset.reader.urdf.meshes import Triangles, read_mesh
from wheelleg_exp.asset.reader.urdf.simulator import Placed, Seen
from wheelleg_exp.asset.reader.urdf.xml import Element

LONGEST_NAME = 100  # of a mesh, whose file's name is longer
KINDS: dict[str, ShapeKind] = {"box": "box", "sphere": "sphere", "cylinder": "cylinder", "capsule": "capsule"}


class Shapes:
    """All shapes of a robot, by link."""

    def __init__(self, document: Document, tree: Tree, seen: dict[str, Seen], files: Files) -> None:
        self.document, self.files = document, files
        self.looks = Looks(document)
        self._loaded: dict[str, Triangles | str] = {}
        self._meshes: dict[str, Mesh] = {}
        self._taken = Numbered()
        self._made = {name: self._of(name, seen[name]) for name in tree.links}

    def solids(self) -> dict[str, list[Shape]]:
        """Return the colliders of each link."""
        return {name: [shape for shape, geom in made if geom.collides] for name, made in self._made.items()}

    def geoms(self, link: Link) -> tuple[Geom, ...]:
        """Return the geoms of a link."""
        return tuple(geom for _, geom in self._made[link.name])

    def meshes(self) -> tuple[Mesh, ...]:
        """Return the meshes in use, equal ones once."""
        return tuple(self._meshes.values())

    def _of(self, owner: str, seen: Seen) -> list[tuple[Shape, Geom]]:
        made = []
        for placed in seen.shapes:
            shape = self._shape(placed)
            if shape is not None:
                made.append((shape, self._geom(owner, placed, shape)))
        return made

    def _geom(self, owner: str, placed: Placed, shape: Shape) -> Geom:
        name = self._name(owner, placed)
        what = "collider" if placed.collides else "visual"
        self.document.ledger.mapped(placed.element.path, placed.element.tag, f"{what} geom {name} ({shape.kind})")
        material, rgba = (None, None) if placed.collides else self.looks.of(placed.element)
        return Geom(
            name=name,
            path=placed.element.path,
            kind=shape.kind,
            size=shape.size,
            pose=placed.pose if placed.kind or shape.kind == "mesh" else shape.frame.pose(),
            collides=placed.collides,
            drawn=not placed.collides,
            mesh=self._mesh(placed, shape) if shape.kind == "mesh" else None,
            material=material,
            rgba=rgba,
        )

    def _name(self, owner: str, placed: Placed) -> str:
        """Return a geom's name: the link's, the element's own if it has one, and what it is."""
        own = self.document.text(placed.element, "name", "geom name") or ""
        short = own if own == owner or own.startswith(f"{owner}_") else "_".join(filter(None, (owner, own)))
        if placed.collides and not own:
            short += "_collision"
        return self._taken.take(short if placed.collides else f"{short}_visual")

    # ------------------------------------------------------------ shapes
    def _shape(self, placed: Placed) -> Shape | None:
        frame = Frame.of(placed.pose)
        if placed.kind:
            if min(placed.size) <= 0:
                self._left(placed, "it has no size")
                return None
            return Shape(KINDS[placed.kind], placed.size, frame)
        geometry = placed.element.first("geometry")
        mesh = geometry.first("mesh") if geometry else None
        if mesh is not None:
            return self._mesh_shape(placed, mesh, frame)
        kinds = [child.tag for child in geometry.children] if geometry else []
        self._left(placed, f"a shape of kind '{kinds[0]}' is not supported" if kinds else "it has no shape")
        return None

    def _mesh_shape(self, placed: Placed, mesh: Element, frame: Frame) -> Shape | None:
        name = self.document.text(mesh, "filename", "mesh file") or ""
        scale = self.document.numbers(mesh, "scale", 3, "the mesh's points") or (1.0, 1.0, 1.0)
        found = self._load(name)
        if isinstance(found, str):
            self.document.ledger.leave(mesh.path, "filename", found, name)
            self._left(placed, f"mesh '{name}': {found}")
            return None
        vertices, faces = found[0] * scale, found[1]
        if np.prod(scale) < 0:
            faces = faces[:, ::-1]
        if _area(vertices, faces) < SMALLEST_AREA:
            self._left(placed, f"mesh '{name}': it has no surface")
            return None
        if len(vertices) == 3:  # MuJoCo wants four points
            vertices = np.vstack([vertices, vertices.mean(axis=0)])
        shape = Shape("mesh", (), frame, vertices, faces)
        return self._solid(placed, shape) if placed.collides else shape

    def _solid(self, placed: Placed, shape: Shape) -> Shape:
        """Return what a mesh collides as: its hull, as everywhere in MuJoCo, or a thin box when it is flat."""
        flat = flat_to_box(shape)
        if flat is not shape:
            self.document.ledger.warn(f"{placed.element.path}: a flat collider became a thin box")
        return flat

    def _load(self, name: str) -> Triangles | str:
        """Return a file's triangles, or why there are none."""
        if name not in self._loaded:
            path = self.files.find(name) if name else None
            if path is None:
                self._loaded[name] = "the file is not there" if name else "it names no file"
            else:
                try:
                    self._loaded[name] = read_mesh(path)
                except ValueError as error:
                    self._loaded[name] = str(error)
        return self._loaded[name]

    def _left(self, placed: Placed, reason: str) -> None:
        element, ledger = placed.element, self.document.ledger
        ledger.leave(element.path, element.tag, reason)
        if placed.collides:
            ledger.warn(f"{element.path}: a collider was left out: {reason}")

    def _mesh(self, placed: Placed, shape: Shape) -> str:
        """Return the name of a shape's mesh: its file's, numbered where others have it; equal ones are kept once."""
        assert shape.vertices is not None
        assert shape.faces is not None
        vertices = np.round(shape.vertices, 9) + 0.0
        key = hashlib.sha256(vertices.tobytes() + shape.faces.tobytes() + bytes([placed.collides])).hexdigest()
        if key not in self._meshes:
            self._meshes[key] = Mesh(self._mesh_name(placed), vertices, shape.faces, placed.collides)
        return self._meshes[key].name

    def _mesh_name(self, placed: Placed) -> str:
        mesh = next(element for element in placed.element.walk() if element.tag == "mesh")
        file = PurePosixPath(mesh.attributes["filename"].replace("\\", "/"))
        name = file.stem[:LONGEST_NAME] + ("" if placed.collides else "_visual")
        taken = {item.name.lower() for item in self._meshes.values()}  # file systems may not tell cases apart
        candidate, number = name, 2
        while candidate.lower() in taken:
            candidate, number = f"{name}_{number}", number + 1
        return candidate


def _area(vertices: Array, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
