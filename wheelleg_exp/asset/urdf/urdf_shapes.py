"""Convert URDF visuals and colliders to geoms: primitives as MuJoCo reads them, meshes from their files."""

from __future__ import annotations

import hashlib
from pathlib import PurePosixPath

import numpy as np

from wheelleg_exp.asset.file_limits import MOST_POINTS, MOST_SHAPES, require_near, require_size
from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.robot_description import Geom, Material, Mesh, Numbered, Rgba, ShapeKind
from wheelleg_exp.asset.urdf.mesh_files import Files, Triangles, read_mesh, reader_of
from wheelleg_exp.asset.urdf.urdf_document import Document, Element
from wheelleg_exp.asset.urdf.urdf_tree import Placed, Seen, Tree
from wheelleg_exp.asset.usd.gprims import SMALLEST_AREA, Shape, area, flat_to_box
from wheelleg_exp.errors import AssetError


class Looks:
    """The named colours of a URDF; ``used`` contains the materials that the URDF's shapes have."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self._colors: dict[str, Rgba] = {}
        for element in document.root.walk():
            if element.tag == "material":
                name, color = element.attributes.get("name"), self._color(element)
                if name and color is not None:
                    self._colors.setdefault(name, color)
                if element.first("color") is not None:
                    self.document.ledger.mapped(element.path, "name", "material")
        self.used: dict[tuple[str, Rgba], Material] = {}
        self._taken = Numbered()

    def _color(self, element: Element) -> Rgba | None:
        color = element.first("color")
        try:
            values = self.document.numbers(color, "rgba", 4, "material rgba") if color else None
        except AssetError as error:
            self.document.ledger.leave(element.path, "color", "a colour is four numbers", error.message)
            return None
        if values is None:
            return None
        r, g, b, a = (min(max(value, 0.0), 1.0) for value in values)
        return r, g, b, a

    def of(self, shape: Element) -> tuple[str | None, Rgba | None]:
        """Return the name of a shape's material; without a material, return the shape's colour."""
        element = shape.first("material")
        if element is None:
            return None, None
        name = self.document.text(element, "name", "material") or ""
        color = self._color(element) or self._colors.get(name)
        if color is None:
            if name:
                self.document.ledger.leave(element.path, "name", "a material without colour", name)
            return None, None
        if not name:
            return None, color
        if (name, color) not in self.used:
            self.used[name, color] = Material(self._taken.take(name), color)
        return self.used[name, color].name, None


LONGEST_NAME = 100  # bytes
KINDS: dict[str, ShapeKind] = {"box": "box", "sphere": "sphere", "cylinder": "cylinder", "capsule": "capsule"}


class Shapes:
    """The geoms of each link of a robot."""

    def __init__(self, document: Document, tree: Tree, seen: dict[str, Seen], files: Files) -> None:
        self.document, self.files = document, files
        self._points, self._where = 0, str(document.source)
        require_size(sum(len(item.shapes) for item in seen.values()), MOST_SHAPES, "shapes", where=self._where)
        self.looks = Looks(document)
        self._loaded: dict[str, Triangles | str] = {}
        self.meshes: dict[str, Mesh] = {}
        self._taken, self._mesh_names = Numbered(), Numbered()
        made = {name: self._of(name, seen[name]) for name in tree.links}
        self.geoms = {name: tuple(geom for _, geom in pairs) for name, pairs in made.items()}
        self.solids = {name: [shape for shape, geom in pairs if geom.collides] for name, pairs in made.items()}

    def _of(self, owner: str, seen: Seen) -> list[tuple[Shape, Geom]]:
        made = []
        for placed in seen.shapes:
            shape = self._shape(placed)
            if shape is not None:
                made.append((shape, self._geom(owner, placed, shape)))
        return made

    def _geom(self, owner: str, placed: Placed, shape: Shape) -> Geom:
        own = self.document.text(placed.element, "name", "geom name") or ""
        short = own if own == owner or own.startswith(f"{owner}_") else "_".join(filter(None, (owner, own)))
        if placed.collides and not own:
            short += "_collision"
        name = self._taken.take(short if placed.collides else f"{short}_visual")
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

    # ------------------------------------------------------------ shapes
    def _shape(self, placed: Placed) -> Shape | None:
        frame = Frame.of(placed.pose)
        if placed.kind:
            if min(placed.size) <= 0:
                self._left(placed, "its size is zero")
                return None
            return Shape(KINDS[placed.kind], placed.size, frame)
        geometry = placed.element.first("geometry")
        mesh = placed.element.first("geometry", "mesh")
        if mesh is not None:
            name = self.document.text(mesh, "filename", "mesh file") or ""
            scale = self.document.numbers(mesh, "scale", 3, "the mesh's points") or (1.0, 1.0, 1.0)
            if name not in self._loaded:
                try:
                    if not name:
                        raise ValueError("no file is named")
                    reader_of(name)
                    path = self.files.find(name)
                    self._loaded[name] = "the file is missing" if path is None else read_mesh(path)
                except ValueError as error:
                    self._loaded[name] = str(error)
            if isinstance(found := self._loaded[name], str):
                self.document.ledger.leave(mesh.path, "filename", found, name)
                self._left(placed, f"mesh '{name}': {found}")
                return None
            with np.errstate(over="ignore"):
                vertices, faces = found[0] * scale, found[1]
            require_near(vertices, key=mesh.path, where=self._where)
            if np.prod(scale) < 0:
                faces = faces[:, ::-1]
            if area(vertices, faces) < SMALLEST_AREA:
                self._left(placed, f"mesh '{name}': it has no surface")
                return None
            if len(vertices) == 3:  # MuJoCo needs four points
                vertices = np.vstack([vertices, vertices.mean(axis=0)])
            shape = Shape("mesh", (), frame, vertices, faces)
            self._points += shape.points
            require_size(self._points, MOST_POINTS, "points and triangles of meshes", key=mesh.path, where=self._where)
            flat = flat_to_box(shape) if placed.collides else shape  # MuJoCo collides convex hulls.
            if flat is not shape:
                self.document.ledger.warn(f"{placed.element.path}: a flat collider became a thin box")
            return flat
        kinds = [child.tag for child in geometry.children] if geometry else []
        self._left(placed, f"a shape of kind '{kinds[0]}' is not supported" if kinds else "it has no shape")
        return None

    def _left(self, placed: Placed, reason: str) -> None:
        element, ledger = placed.element, self.document.ledger
        ledger.leave(element.path, element.tag, reason)
        if placed.collides:
            ledger.warn(f"{element.path}: a collider was left out: {reason}")

    def _mesh(self, placed: Placed, shape: Shape) -> str:
        """Return the name of a shape's mesh: its file's name, numbered if repeated. Equal meshes are stored once."""
        assert shape.vertices is not None
        assert shape.faces is not None
        # A visual and a collider never share a mesh file, because they need different mesh inertia modes in MuJoCo.
        vertices = np.round(shape.vertices, 9) + 0.0
        key = hashlib.sha256(vertices.tobytes() + shape.faces.tobytes() + bytes([placed.collides])).hexdigest()
        if key not in self.meshes:
            mesh = next(element for element in placed.element.walk() if element.tag == "mesh")
            stem = PurePosixPath(mesh.attributes["filename"].replace("\\", "/")).stem.encode()[:LONGEST_NAME]
            name = stem.decode(errors="ignore") + ("" if placed.collides else "_visual")
            name += self._mesh_names.take(name.lower())[len(name) :]
            self.meshes[key] = Mesh(name, vertices, shape.faces, placed.collides)
        return self.meshes[key].name
