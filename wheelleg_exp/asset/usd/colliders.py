"""Find colliders, visuals, and sites: gprims, all gprims below a prim with CollisionAPI, and copies of instancers.

Sites are named frames: Isaac's sensors, and the sites of MuJoCo's and Newton's schemas with their looks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sized
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from wheelleg_exp.asset.file_limits import FARTHEST, MOST_POINTS, MOST_SHAPES, require_size
from wheelleg_exp.asset.rigid_geometry import Array, Frame
from wheelleg_exp.asset.robot_description import Extra, Site, unique_names
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links, shown_names
from wheelleg_exp.asset.usd.gprims import Shape, bounding_box, bounding_sphere, flat_to_box, plane_as_box, shape_of
from wheelleg_exp.asset.usd.materials import display_color
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas
from wheelleg_exp.errors import AssetError

SITE_SCHEMAS = {"MjcSiteAPI", "NewtonSiteAPI"}
SHAPES = {"sphere", "capsule", "ellipsoid", "cylinder", "box"}  # MuJoCo's shapes of sites
GREY = (0.5, 0.5, 0.5, 1.0)  # default colour of a site
SAME_ANGLE = 1e-6  # rad between a shape's frame and its prim's


def is_site(prim: Usd.Prim) -> bool:
    """Return whether a prim marks a place and is neither drawn nor solid."""
    kind = str(prim.GetTypeName())
    return (kind.startswith("Isaac") and kind.endswith("Sensor")) or bool(SITE_SCHEMAS & set(schemas(prim)))


def find_sites(stage: Stage, links: Links) -> dict[str, list[Site]]:
    """Return the sites of each body, by the body's path.

    The USD library does not know the types of Isaac's sensors, so their transform is that of the parent prim.
    """
    found: dict[str, list[Site]] = {}
    for prim, name in _named(stage):
        if (link := links.owner(prim.GetPath())) is not None:
            found.setdefault(link.path, []).append(_site(stage, prim, name, link))
    return found


def world_sites(stage: Stage, links: Links) -> list[Site]:
    """Return the sites that belong to no body."""
    return [_site(stage, prim, name, None) for prim, name in _named(stage) if links.owner(prim.GetPath()) is None]


def _named(stage: Stage) -> list[tuple[Usd.Prim, str]]:
    prims = [prim for prim in stage.prims if is_site(prim)]
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    return [(prim, names[str(prim.GetPath())]) for prim in prims]


def _site(stage: Stage, prim: Usd.Prim, name: str, link: Link | None) -> Site:
    path, base = str(prim.GetPath()), link.frame if link else Frame.identity()
    stage.ledger.mapped(path, str(prim.GetTypeName()), f"site {name}")
    frame = base.inverse() @ stage.frame(prim)
    return Site(name, path, frame.pose(), _look(stage, prim, base, frame))


def _look(stage: Stage, prim: Usd.Prim, base: Frame, frame: Frame) -> Extra:
    """Return a site's shape, size, colour, and group, if the prim is a shape that MuJoCo can draw at a site."""
    found: dict[str, str | int | tuple[float, ...]] = {}
    if prim.IsA(UsdGeom.Gprim):
        shape = shape_of(prim, base.inverse().matrix() @ stage.matrix(prim))
        if shape and shape.kind in SHAPES and shape.frame.distance(frame)[1] < SAME_ANGLE:
            found |= {"type": shape.kind, "size": shape.size}
        if (color := display_color(prim)) not in (None, GREY):
            found["rgba"] = tuple(color)
    if group := stage.ledger.read(prim, "mjc:group", "group"):
        found["group"] = int(group)
    return {key: value for key, value in found.items() if (key, value) != ("type", "sphere")}


@dataclass(frozen=True, eq=False)
class Placed:
    """A gprim of a prototype in one instance: its map (4x4) to the world in metres, and the instance's index."""

    prim: Usd.Prim
    carrier: Usd.Prim | None
    matrix: Array
    index: int


def placed_gprims(stage: Stage, instancer: Usd.Prim) -> Iterator[Placed]:
    """Yield the gprims of all instances; an instancer that cannot be expanded is reported."""
    api, time = UsdGeom.PointInstancer(instancer), Usd.TimeCode.Default()
    roots = [stage.usd.GetPrimAtPath(path) for path in api.GetPrototypesRel().GetForwardedTargets()]
    if not roots or not all(roots):
        return _refuse(stage, instancer, "its prototypes are missing")
    shapes = [_gprims(root) for root in roots]
    if any("PhysicsRigidBodyAPI" in schemas(prim) for root in roots for prim in Usd.PrimRange(root)):
        return _refuse(stage, instancer, "its prototypes are rigid bodies")
    if any(len(values) > MOST_SHAPES for values in _arrays(instancer)):
        return _refuse(stage, instancer, f"it makes more than {MOST_SHAPES:,} instances")
    indices, maps = _instance_maps(api, time)
    if indices is None or len(indices) != len(maps) or any(not 0 <= i < len(roots) for i in indices):
        return _refuse(stage, instancer, "its protoIndices do not fit its positions and prototypes")
    if sum(len(shapes[i]) for i in indices) > MOST_SHAPES:
        return _refuse(stage, instancer, f"it makes more than {MOST_SHAPES:,} shapes")
    if not all((np.abs(matrix) <= FARTHEST).all() for matrix in maps):
        return _refuse(stage, instancer, f"its transforms are not finite, or reach more than {FARTHEST:g} m")
    stage.ledger.mapped(instancer.GetPath(), "PointInstancer", f"the shapes of {len(indices)} instances")
    above = stage.matrix(instancer)
    inside = UsdGeom.XformCache(time)
    for number, (which, local) in enumerate(zip(indices, maps, strict=True)):
        for gprim, carrier in shapes[which]:
            within = np.array(inside.ComputeRelativeTransform(gprim, roots[which])[0], dtype=float).T
            yield Placed(gprim, carrier, above @ local @ within, number)


def _refuse(stage: Stage, instancer: Usd.Prim, reason: str) -> None:
    stage.ledger.leave(instancer.GetPath(), "PointInstancer", reason)
    stage.ledger.warn(f"{instancer.GetPath()}: a PointInstancer was left out: {reason}")


def _gprims(root: Usd.Prim) -> list[tuple[Usd.Prim, Usd.Prim | None]]:
    found = []
    carriers: dict[object, Usd.Prim] = {}
    for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies()):
        carrier = prim if "PhysicsCollisionAPI" in schemas(prim) else carriers.get(prim.GetPath().GetParentPath())
        if prim.IsA(UsdGeom.Gprim):
            found.append((prim, carrier))
        elif carrier is not None:
            carriers[prim.GetPath()] = carrier
    return found


def _arrays(instancer: Usd.Prim) -> Iterator[Sized]:
    names = ("protoIndices", "positions", "orientations", "orientationsf", "scales", "invisibleIds", "ids")
    values = (instancer.GetAttribute(name).Get() for name in names if instancer.HasAttribute(name))
    yield from (value for value in values if isinstance(value, Sized))


def _instance_maps(api: UsdGeom.PointInstancer, time: Usd.TimeCode) -> tuple[list[int] | None, list[Array]]:
    """Return the prototype index and the map of each instance; masked instances are left out."""
    which = api.GetProtoIndicesAttr().Get(time)
    if which is None or np.asarray(which).dtype.kind not in "iu":
        return None, []
    transforms = api.ComputeInstanceTransformsAtTime(time, time)
    mask = list(api.ComputeMaskAtTime(time))
    shown = [int(i) for number, i in enumerate(which) if number >= len(mask) or mask[number]]
    return shown, [np.array(matrix, dtype=float).T for matrix in transforms]


SHAPED = {"Cube", "Sphere", "Capsule", "Capsule_1", "Cylinder", "Cylinder_1", "Cone", "Plane", "Mesh"}


@dataclass(eq=False)
class Piece:
    """A gprim of a body (None: the world). ``carrier`` is the prim with CollisionAPI, None for a visual.

    ``instance`` is the index of a PointInstancer's copy.
    """

    prim: Usd.Prim
    link: Link | None
    shape: Shape
    carrier: Usd.Prim | None
    collides: bool
    drawn: bool
    instance: int | None = None

    @property
    def path(self) -> str:
        """The gprim's path."""
        return str(self.prim.GetPath())

    @property
    def key(self) -> str:
        """A unique key: the path, with the index of the instance."""
        return self.path if self.instance is None else f"{self.path}_{self.instance}"


def find_pieces(stage: Stage, links: Links) -> list[Piece]:
    """Return all shapes, in the order of the stage. Unsupported shapes are reported.

    Raises:
        AssetError: there are too many shapes or points of meshes for a robot, or a shape has no valid size or place.
    """
    pieces, points = [], 0
    for piece in filter(None, _pieces(stage, links)):
        pieces.append(piece)
        points += piece.shape.points
        require_size(len(pieces), MOST_SHAPES, "shapes", key=piece.path)
        require_size(points, MOST_POINTS, "points and triangles of meshes", key=piece.path)
    return pieces


def _pieces(stage: Stage, links: Links) -> Iterator[Piece | None]:
    # CollisionAPI applies to all gprims below a prim. Parents come first, so a prim finds its parent's entry.
    carriers: dict[Sdf.Path, Usd.Prim] = {}
    for prim in stage.prims:
        path = prim.GetPath()
        above = carriers.get(path.GetParentPath())
        carrier = prim if "PhysicsCollisionAPI" in schemas(prim) else above
        if prim.IsA(UsdGeom.Gprim):
            if above is not None:  # a gprim's own schema does not apply to its children
                carriers[path] = above
            if not is_site(prim):
                yield _piece(stage, links.owner(path), prim, carrier, stage.matrix(prim))
        elif prim.IsA(UsdGeom.PointInstancer):
            yield from _instances(stage, links.owner(path), prim, carrier)
        elif carrier is not None:
            carriers[path] = carrier


def _instances(stage: Stage, link: Link | None, prim: Usd.Prim, above: Usd.Prim | None) -> Iterator[Piece | None]:
    for item in placed_gprims(stage, prim):
        yield _piece(stage, link, item.prim, item.carrier or above, item.matrix, item.index)


def _piece(
    stage: Stage,
    link: Link | None,
    prim: Usd.Prim,
    carrier: Usd.Prim | None,
    world: Array,
    instance: int | None = None,
) -> Piece | None:
    solid = carrier is not None and stage.ledger.read(carrier, "physics:collisionEnabled", "the choice of colliders")
    collides = carrier is not None and solid is not False
    drawn = _drawn(prim)
    if carrier is None and not drawn:
        stage.ledger.leave(prim.GetPath(), str(prim.GetTypeName()), "neither drawn nor solid")
        return None
    inside = link.frame.inverse().matrix() @ world if link else world
    shape = shape_of(prim, inside)
    reason = ""
    if shape is not None:
        _require_sane(prim, shape)
        if carrier is not None:
            shape = _approximated(stage, prim, carrier, shape, link is None)
            stage.ledger.mapped(carrier.GetPath(), "PhysicsCollisionAPI", "colliders")
        elif shape.vertices is not None and shape.faces is None:  # MuJoCo builds a hull from points, drawn or not
            shape = flat_to_box(shape)
        if shape.kind == "plane" and (link is not None or carrier is None):
            shape = None if collides else plane_as_box(prim, inside)
            reason = "a plane collides only where it stands still, in the world"
    if shape is None or _empty(shape):
        _unsupported(stage, prim, collides, "its size is zero" if shape else reason)
        return None
    if shape.note:
        stage.ledger.assume(prim.GetPath(), f"{prim.GetTypeName()}: {shape.note}", shape.kind)
    if not collides and carrier is not None:
        stage.ledger.assume(prim.GetPath(), "collisionEnabled is 0: no contact, but it counts for the mass", "visual")
    return Piece(prim, link, shape, carrier, collides, drawn, instance)


def _drawn(prim: Usd.Prim) -> bool:
    imageable = UsdGeom.Imageable(prim)
    if imageable.ComputePurpose() not in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
        return False
    return bool(imageable.ComputeVisibility() != UsdGeom.Tokens.invisible)


def _empty(shape: Shape) -> bool:
    return shape.kind != "plane" and any(size <= 0 for size in shape.size)


def _unsupported(stage: Stage, prim: Usd.Prim, collides: bool, reason: str) -> None:
    kind = str(prim.GetTypeName())
    if not reason:
        reason = "it has no valid triangles" if kind in SHAPED else "this kind of shape is not supported"
    stage.ledger.leave(prim.GetPath(), kind, reason)
    if collides:
        stage.ledger.warn(f"{prim.GetPath()}: a collider was left out: {reason} ({kind})")


def _approximated(stage: Stage, prim: Usd.Prim, carrier: Usd.Prim, shape: Shape, static: bool) -> Shape:
    """Return the collision shape of a mesh. MuJoCo always uses a mesh's convex hull."""
    wanted = stage.ledger.read(carrier, "physics:approximation", "the collider's shape")
    if prim.GetPath() != carrier.GetPath():
        wanted = stage.ledger.read(prim, "physics:approximation", "the collider's shape") or wanted
    if shape.vertices is None:
        return shape
    if prim.GetTypeName() != "Mesh":
        return flat_to_box(shape)
    if wanted == "boundingCube":
        return bounding_box(shape)
    if wanted == "boundingSphere":
        return bounding_sphere(shape)
    if wanted not in ("convexHull", None):
        stage.ledger.warn(f"{prim.GetPath()}: approximation '{wanted}' became the mesh's convex hull")
    flat = flat_to_box(shape)
    if flat is not shape and not static:
        stage.ledger.warn(f"{prim.GetPath()}: a flat collider on a moving body became a thin box")
    return flat


def _require_sane(prim: Usd.Prim, shape: Shape) -> None:
    numbers = np.array(shape.size) if shape.vertices is None else shape.vertices
    if not np.isfinite(numbers).all():
        message, expected = "the shape's size or points are not finite", "finite numbers"
    elif numbers.size and np.abs(numbers).max() > FARTHEST:
        message = f"the shape's size or points reach {np.abs(numbers).max():.3g} m"
        expected = f"less than {FARTHEST:g} m"
    else:
        return
    raise AssetError(message, key=str(prim.GetPath()), expected=expected)
