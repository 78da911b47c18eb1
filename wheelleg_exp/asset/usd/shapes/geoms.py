"""Names the shapes, gathers their meshes once, and gives each body its geoms."""

from __future__ import annotations

import hashlib

import numpy as np
from pxr import UsdGeom

from wheelleg_exp.asset.description import Geom, Material, Mesh, Rgba
from wheelleg_exp.asset.naming import Numbered, file_stem, unique_names
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, shown_names
from wheelleg_exp.asset.usd.shapes.colliders import Piece
from wheelleg_exp.asset.usd.shapes.gprims import Shape
from wheelleg_exp.asset.usd.shapes.materials import Looks, friction_of
from wheelleg_exp.asset.usd.stage import Stage

SMALLEST_VOLUME = 1e-13  # m³ of a mesh's box; below it MuJoCo's compiler finds no volume for a solid


class Geoms:
    """All shapes of a stage as geoms, by body."""

    def __init__(self, stage: Stage, pieces: list[Piece]) -> None:
        self.stage, self.looks = stage, Looks(stage)
        self._pieces: dict[str | None, list[Piece]] = {}
        for piece in pieces:
            self._pieces.setdefault(piece.link.path if piece.link else None, []).append(piece)
        self._meshes: dict[str, Mesh] = {}
        self._taken, self._files = Numbered(), Numbered()
        self._surfaces = {piece.key: self._surface(piece) for piece in pieces if piece.drawn}
        self._materials = self.looks.named()
        self._names = {key: _names(key, group) for key, group in self._pieces.items()}

    def pieces_of(self, link: Link) -> list[Piece]:
        """Return the shapes of a body as read."""
        return self._pieces.get(link.path, [])

    def of(self, link: Link | None) -> tuple[Geom, ...]:
        """Return the geoms of a body (None: the world)."""
        key = link.path if link else None
        owner = link.name if link else "world"
        return tuple(self._geom(piece, owner, self._names[key]) for piece in self._pieces.get(key, []))

    def materials(self) -> list[Material]:
        """Return the materials in use, by name."""
        return list(self._materials.values())

    def meshes(self) -> list[Mesh]:
        """Return the meshes in use; call it after all geoms were asked for."""
        return list(self._meshes.values())

    def _surface(self, piece: Piece) -> tuple[str | None, Rgba | None]:
        """Return how a shape looks; a mesh that looks different face by face as most of its faces do."""
        own = self.looks.look(piece.prim)
        if own != (None, None):
            return own
        subsets = [UsdGeom.Subset(prim) for prim in piece.prim.GetChildren() if prim.IsA(UsdGeom.Subset)]
        for subset in sorted(subsets, key=_faces, reverse=True):
            look = self.looks.look(subset.GetPrim())
            if look != (None, None):
                rule = "each part of the mesh has a material of its own: that of most faces"
                self.stage.ledger.assume(piece.path, rule, subset.GetPrim().GetName())
                return look
        return None, None

    def _name(self, owner: str, short: str, collides: bool) -> str:
        """Return a geom's name: the body's, the shape's, and ``visual``; numbered where that is taken."""
        name = short if f"{short}_".startswith(f"{owner}_") else f"{owner}_{short}".rstrip("_")
        name += "" if collides else "_visual"
        return self._taken.take(name)

    def _geom(self, piece: Piece, owner: str, names: dict[str, str]) -> Geom:
        shape, path = piece.shape, piece.path
        material, rgba = self._surfaces.get(piece.key, (None, None))
        kind = "collider" if piece.collides else "visual"
        name = self._name(owner, names[piece.key], piece.collides)
        self.stage.ledger.mapped(path, str(piece.prim.GetTypeName()), f"{kind} geom {name} ({shape.kind})")
        return Geom(
            name=name,
            path=path,
            kind=shape.kind,
            size=shape.size,
            pose=shape.frame.pose(),
            collides=piece.collides,
            drawn=piece.drawn,
            mesh=self._mesh(name, shape, piece.collides) if shape.kind == "mesh" else None,
            material=self._materials[material].name if material else None,
            rgba=rgba,
            friction=friction_of(self.stage, piece.prim) if piece.collides else None,
        )

    def _mesh(self, name: str, shape: Shape, collides: bool) -> str:
        """Return the name of a shape's mesh; equal meshes are kept once."""
        assert shape.vertices is not None
        solid = collides and float(np.prod(np.ptp(shape.vertices, axis=0))) > SMALLEST_VOLUME
        vertices = np.round(shape.vertices, 9) + 0.0
        faces = shape.faces if shape.faces is not None and len(shape.faces) else np.zeros((0, 3), dtype=np.int64)
        key = hashlib.sha256(vertices.tobytes() + faces.astype(np.int64).tobytes() + bytes([solid])).hexdigest()
        if key not in self._meshes:
            self._meshes[key] = Mesh(self._mesh_name(name), vertices, faces, solid)
        return self._meshes[key].name

    def _mesh_name(self, name: str) -> str:
        """Return a name for a mesh and its file, told from the others on disks that ignore case, too."""
        stem = file_stem(name)
        return stem + self._files.take(stem.lower())[len(stem) :]


def _faces(subset: UsdGeom.Subset) -> int:
    indices = subset.GetIndicesAttr().Get()
    return len(indices) if hasattr(indices, "__len__") else 0


def _names(key: str | None, pieces: list[Piece]) -> dict[str, str]:
    """Return the shapes' names within their body: the leaf, with parents where two leaves are equal.

    Drawn and solid shapes do not clash, because visuals get an ending of their own.
    """
    base = key or ""
    out = {}
    for collides in (True, False):
        chosen = [piece for piece in pieces if piece.collides is collides]
        keys = {piece.key.removeprefix(base): piece.key for piece in chosen}
        shown = shown_names([piece.prim for piece in chosen if piece.instance is None])
        short = unique_names(keys, {path.removeprefix(base): name for path, name in shown.items()})
        out.update({full: short[relative] for relative, full in keys.items()})
    return out
