"""Make the MuJoCo geoms of each body, store each mesh once, and find the pairs of bodies that never touch."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations, combinations_with_replacement, product

import numpy as np
from pxr import Sdf, UsdGeom, UsdPhysics

from wheelleg_exp.asset.robot_description import Extra, Geom, Mesh, Numbered, Rgba, unique_names
from wheelleg_exp.asset.usd.bodies.body_tree import Graph
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links, shown_names
from wheelleg_exp.asset.usd.colliders import Piece
from wheelleg_exp.asset.usd.gprims import Shape
from wheelleg_exp.asset.usd.joints.usd_joints import Joint
from wheelleg_exp.asset.usd.materials import Looks, friction_of
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas

SMALLEST_VOLUME = 1e-13  # m³
LONGEST_FILE = 100  # characters


class Geoms:
    """Convert shapes to MuJoCo geoms, grouped by body; ``bits`` maps prim paths of shapes to collision bits."""

    def __init__(self, stage: Stage, pieces: list[Piece], bits: Mapping[str, Extra]) -> None:
        self.stage, self.looks, self.bits = stage, Looks(stage), bits
        self.pieces: dict[str | None, list[Piece]] = {}
        for piece in pieces:
            self.pieces.setdefault(piece.link.path if piece.link else None, []).append(piece)
        self.meshes: dict[str, Mesh] = {}
        self._taken, self._files = Numbered(), Numbered()
        self._surfaces = {piece.path: self._surface(piece) for piece in pieces if piece.drawn}
        self.materials = self.looks.named()
        self._names = {key: _names(key, group) for key, group in self.pieces.items()}

    def of(self, link: Link | None) -> tuple[Geom, ...]:
        """Return the geoms of a body (None: the world)."""
        key = link.path if link else None
        owner = link.name if link else "world"
        return tuple(self._geom(piece, owner, self._names[key]) for piece in self.pieces.get(key, []))

    def _surface(self, piece: Piece) -> tuple[str | None, Rgba | None]:
        """Return a shape's material or colour; a mesh with several materials gets the material of most faces."""
        own = self.looks.look(piece.prim)
        if own != (None, None):
            return own
        subsets = [UsdGeom.Subset(prim) for prim in piece.prim.GetChildren() if prim.IsA(UsdGeom.Subset)]
        for subset in sorted(subsets, key=_faces, reverse=True):
            look = self.looks.look(subset.GetPrim())
            if look != (None, None):
                rule = "parts of the mesh have different materials: that of most faces"
                self.stage.ledger.assume(piece.path, rule, subset.GetPrim().GetName())
                return look
        return None, None

    def _geom(self, piece: Piece, owner: str, names: dict[str, str]) -> Geom:
        shape, path = piece.shape, piece.path
        material, rgba = self._surfaces.get(piece.path, (None, None))
        kind = "collider" if piece.collides else "visual"
        # A geom's name consists of its body's name, its shape's name and, for a visual, the suffix ``_visual``.
        short = names[piece.path]
        name = short if f"{short}_".startswith(f"{owner}_") else f"{owner}_{short}".rstrip("_")
        name += "" if piece.collides else "_visual"
        name = self._taken.take(name)
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
            material=self.materials[material].name if material else None,
            rgba=rgba,
            friction=friction_of(self.stage, piece.prim) if piece.collides else None,
            extra=self.bits.get(path, {}),
        )

    def _mesh(self, name: str, shape: Shape, collides: bool) -> str:
        assert shape.vertices is not None
        solid = collides and float(np.prod(np.ptp(shape.vertices, axis=0))) > SMALLEST_VOLUME
        vertices = np.round(shape.vertices, 9) + 0.0
        faces = shape.faces if shape.faces is not None and len(shape.faces) else np.zeros((0, 3), dtype=np.int64)
        key = hashlib.sha256(vertices.tobytes() + faces.astype(np.int64).tobytes() + bytes([solid])).hexdigest()
        if key not in self.meshes:
            # Mesh file names are cut to 100 characters, because most file systems allow at most 255 bytes.
            stem = re.sub(r"[^\w-]", "_", name, flags=re.ASCII)[:LONGEST_FILE].strip("_") or "mesh"
            self.meshes[key] = Mesh(stem + self._files.take(stem.lower())[len(stem) :], vertices, faces, solid)
        return self.meshes[key].name


def _faces(subset: UsdGeom.Subset) -> int:
    indices = subset.GetIndicesAttr().Get()
    return len(indices) if hasattr(indices, "__len__") else 0


def _names(key: str | None, pieces: list[Piece]) -> dict[str, str]:
    """Return the shapes' names in their body: the leaf, with parents if two colliders or two visuals have one leaf."""
    base = key or ""
    out = {}
    for collides in (True, False):
        chosen = [piece for piece in pieces if piece.collides is collides]
        keys = {piece.path.removeprefix(base): piece.path for piece in chosen}
        shown = shown_names([piece.prim for piece in chosen])
        short = unique_names(keys, {path.removeprefix(base): name for path, name in shown.items()})
        out.update({full: short[relative] for relative, full in keys.items()})
    return out


WORLD = "world"
MANY = 300  # excludes of bodies
BITS = 31  # of MuJoCo's 32 bits


@dataclass
class _Rules:
    """The collision rules: pairs of sets of shapes that never touch; each set contains the prim paths of its shapes."""

    sides: list[tuple[set[str], set[str]]] = field(default_factory=list)

    def add(self, first: set[str], second: set[str]) -> None:
        if first and second:
            self.sides.append((first, second))

    def classes(self, shapes: Iterable[str]) -> dict[str, int]:
        """Number the shapes by their collision rules: equal rules give equal numbers, and no rule gives 0."""
        known: dict[tuple[int, ...], int] = {(): 0}
        member: dict[str, list[int]] = {}
        for index, pair in enumerate(self.sides):
            for side, paths in enumerate(pair):
                for path in paths:
                    member.setdefault(path, []).append(2 * index + side)
        return {path: known.setdefault(tuple(member.get(path, ())), len(known)) for path in shapes}

    def forbidden(self, classes: Mapping[str, int]) -> set[tuple[int, int]]:
        out = set()
        for first, second in self.sides:
            for a in {classes[path] for path in first}:
                for b in {classes[path] for path in second}:
                    out |= {(a, b), (b, a)}
        return out


def read_filters(
    stage: Stage, links: Links, joints: list[Joint], pieces: list[Piece], quiet: list[frozenset[str]] | None
) -> tuple[tuple[tuple[str, str], ...], Mapping[str, Extra]]:
    """Return the pairs of bodies that never touch, and collision bits of geoms by the shape's prim path.

    A common joint decides whether two bodies touch. Those in one set of ``quiet`` never do; None means all bodies.
    """
    solid = {piece.path: piece for piece in pieces if piece.collides}
    rules = _Rules()
    bare = list(_filtered(stage, links, solid, rules))
    _grouped(stage, solid, rules)
    for part in quiet or ():
        inside = {path for path, piece in solid.items() if piece.link and piece.link.path in part}
        rules.add(inside, inside)
    touching = [joint.links for joint in joints if not joint.may_collide]
    joined = [(first.name, second.name) for first, second in touching if first and second]
    order = {link.name: index for index, link in enumerate(links)} | {WORLD: -1}
    pairs = {_ordered(order, a, b): None for a, b in (*joined, *bare)}
    # If possible, use MJCF <exclude> elements, because they are easier to read than collision bits.
    classes = rules.classes(solid)
    forbidden = rules.forbidden(classes)
    whole, partly = _body_pairs(solid, classes, forbidden)
    excludes_suffice = not partly and len(whole) <= MANY
    apart = sorted({a for a, _ in forbidden})
    if excludes_suffice or len(apart) > BITS - 1:
        if not excludes_suffice:
            stage.ledger.warn(f"too many kinds of collision filters for MuJoCo's bits: {len(partly)} pairs may touch")
        pairs |= {_ordered(order, a, b): None for a, b in whole}
        return tuple(pairs), {}
    # In MuJoCo's contype, bit 0 is for unfiltered shapes; shapes with equal USD collision filters share a bit.
    self_collision = quiet is not None
    bit = {kind: 1 << (index + 1) for index, kind in enumerate(apart)}
    everybody = 1 | sum(bit.values())
    out: dict[str, Extra] = {}
    for path, piece in solid.items():
        kind = classes[path]
        # A cleared bit in ``conaffinity`` forbids contacts with geoms whose ``contype`` is only this bit.
        touches = everybody - sum(bit[other] for other in apart if (kind, other) in forbidden)
        own = bit.get(kind, 1)
        out[path] = {"contype": own if self_collision or piece.link is None else 0, "conaffinity": touches}
    return tuple(pairs), out


def _ordered(order: Mapping[str, int], a: str, b: str) -> tuple[str, str]:
    return (a, b) if order[a] <= order[b] else (b, a)


def _filtered(stage: Stage, links: Links, solid: Mapping[str, Piece], rules: _Rules) -> Iterator[tuple[str, str]]:
    """Yield the body pairs of ``physics:filteredPairs``; add pairs with a single shape to ``rules`` instead."""
    for prim in stage.prims:
        for target in stage.ledger.targets(prim, "physics:filteredPairs", "contact exclude"):
            first, second = _bodies(links, prim.GetPath()), _bodies(links, target)
            if first and second:
                yield from ((a.name, b.name) for a in first for b in second if a is not b)
            else:
                rules.add(_shapes(links, solid, prim.GetPath()), _shapes(links, solid, target))


def _bodies(links: Links, path: Sdf.Path) -> list[Link]:
    owner = links.owner(path)
    if owner is None:
        return links.below(path)
    return [owner] if owner.path == str(path) else []


def _shapes(links: Links, solid: Mapping[str, Piece], path: Sdf.Path) -> set[str]:
    bodies = {link.path for link in _bodies(links, path)}
    inside = {key for key, piece in solid.items() if piece.prim.GetPath().HasPrefix(path)}
    return inside | {key for key, piece in solid.items() if piece.link and piece.link.path in bodies}


def _grouped(stage: Stage, solid: Mapping[str, Piece], rules: _Rules) -> None:
    """Add the pairs of USD collision groups whose shapes never touch to ``rules``."""
    groups = [UsdPhysics.CollisionGroup(p) for p in stage.usd.Traverse() if p.IsA(UsdPhysics.CollisionGroup)]
    if not groups:
        return
    # As in PhysX, a shape that is in several collision groups belongs only to the first of these groups.
    taken: dict[str, Sdf.Path] = {}
    members: dict[Sdf.Path, set[str]] = {}
    for group in groups:
        included = group.GetCollidersCollectionAPI().ComputeMembershipQuery().IsPathIncluded
        places = {path: (piece.prim, piece.carrier) for path, piece in solid.items()}
        inside = {path for path, prims in places.items() if any(prim and included(prim.GetPath()) for prim in prims)}
        double = inside & taken.keys()
        for path in sorted(double):
            rule = f"a collider of two collision groups: the first, {taken[path]}"
            stage.ledger.assume(path, rule, f"not {group.GetPath()}")
        members[group.GetPath()] = inside - double
        taken |= dict.fromkeys(inside - double, group.GetPath())
    table = UsdPhysics.CollisionGroup.ComputeCollisionGroupTable(stage.usd)
    for group in groups:
        place, count = group.GetPath(), len(members[group.GetPath()])
        stage.ledger.mapped(place, "PhysicsCollisionGroup", f"contact excludes of {count} colliders")
        for name in (prop.GetName() for prop in group.GetPrim().GetAuthoredProperties()):
            if name in GROUP_PROPERTIES or name.startswith("collection:colliders"):
                stage.ledger.mapped(place, name, "contact excludes")
    for first, second in combinations_with_replacement([group.GetPath() for group in groups], 2):
        if not table.IsCollisionEnabled(first, second):
            rules.add(members[first], members[second])


GROUP_PROPERTIES = ("physics:filteredGroups", "physics:mergeGroup", "physics:invertFilteredGroups")


def _body_pairs(
    solid: Mapping[str, Piece], classes: Mapping[str, int], forbidden: set[tuple[int, int]]
) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return the body pairs that can never touch, and the body pairs of which only some shapes can touch."""
    if not forbidden:
        return [], []
    kinds: dict[str, set[int]] = {}
    for path, piece in solid.items():
        kinds.setdefault(piece.link.name if piece.link else WORLD, set()).add(classes[path])
    alike: dict[frozenset[int], list[str]] = {}
    for name, found in kinds.items():
        alike.setdefault(frozenset(found), []).append(name)
    whole: list[tuple[str, str]] = []
    partly: list[tuple[str, str]] = []
    for first, second in combinations_with_replacement(alike, 2):
        apart = [(a, b) in forbidden for a in first for b in second]
        if any(apart):
            one, other = alike[first], alike[second]
            (whole if all(apart) else partly).extend(combinations(one, 2) if one is other else product(one, other))
    return whole, partly


SWITCHES = ("physxArticulation:enabledSelfCollisions", "newton:selfCollisionEnabled")


def quiet_parts(stage: Stage, graph: Graph) -> list[frozenset[str]]:
    """Return the body paths of each articulation whose self-collision is disabled."""
    parts: dict[frozenset[str], None] = {}
    for prim in (prim for prim in stage.prims if schemas(prim)):
        values = [stage.ledger.read(prim, name, "contype and conaffinity of the colliders") for name in SWITCHES]
        if all(value is None or value for value in values):
            continue
        # If a USD joint disables self-collision, the setting applies to the bodies that the joint connects.
        # If a USD prim other than a joint disables self-collision, the setting applies to all bodies below the prim.
        path = str(prim.GetPath())
        joined = [link for joint in graph.joints if joint.path == path for link in joint.links if link]
        for link in joined or graph.links.below(Sdf.Path(path)):
            parts[frozenset(other.path for other in graph.component(link))] = None
    return list(parts)
