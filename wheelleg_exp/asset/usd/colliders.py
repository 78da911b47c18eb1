"""Find colliders, visuals, and sites (sensors, named frames): gprims, and all gprims below a prim with CollisionAPI."""

from __future__ import annotations

from dataclasses import dataclass

from pxr import Sdf, Usd, UsdGeom

from wheelleg_exp.asset.file_limits import MOST_POINTS, MOST_SHAPES, require_near, require_size
from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.robot_description import Extra, Site
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links, named
from wheelleg_exp.asset.usd.gprims import Shape, bounding_box, bounding_sphere, flat_to_box, plane_as_box, shape_of
from wheelleg_exp.asset.usd.materials import display_color
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas

SITE_SCHEMAS = {"MjcSiteAPI", "NewtonSiteAPI"}
SHAPES = {"sphere", "capsule", "ellipsoid", "cylinder", "box"}  # MuJoCo's shapes of sites
GREY = (0.5, 0.5, 0.5, 1.0)
SAME_ANGLE = 1e-6  # rad


def is_site(prim: Usd.Prim) -> bool:
    """Return whether a USD prim is a site, which is neither a visual nor a collider."""
    kind = str(prim.GetTypeName())
    return (kind.startswith("Isaac") and kind.endswith("Sensor")) or bool(SITE_SCHEMAS & set(schemas(prim)))


def find_sites(stage: Stage, links: Links) -> dict[str | None, list[Site]]:
    """Return the sites by body path (None: the world); Isaac Sim's sensors have the transform of their parent prim."""
    found: dict[str | None, list[Site]] = {}
    for prim, name in named([prim for prim in stage.prims if is_site(prim)]):
        link = links.owner(prim.GetPath())
        found.setdefault(link.path if link else None, []).append(_site(stage, prim, name, link))
    return found


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


SHAPED = {"Cube", "Sphere", "Capsule", "Capsule_1", "Cylinder", "Cylinder_1", "Cone", "Plane", "Mesh"}


@dataclass(eq=False)
class Piece:
    """A gprim of a body (None: the world); the CollisionAPI of ``carrier`` makes it a collider (None: a visual)."""

    prim: Usd.Prim
    link: Link | None
    shape: Shape
    carrier: Usd.Prim | None
    collides: bool
    drawn: bool

    @property
    def path(self) -> str:
        return str(self.prim.GetPath())


def find_pieces(stage: Stage, links: Links) -> list[Piece]:
    """Return all visuals and colliders of a USD stage, in the order of the stage. Unsupported shapes are reported."""
    pieces, points = list[Piece](), 0
    # A USD prim's CollisionAPI applies to all geometry prims below it; ``stage.prims`` lists parents before children.
    carriers: dict[Sdf.Path, Usd.Prim] = {}
    for prim in stage.prims:
        path = prim.GetPath()
        above = carriers.get(path.GetParentPath())
        carrier = prim if "PhysicsCollisionAPI" in schemas(prim) else above
        inherited = above if prim.IsA(UsdGeom.Gprim) else carrier
        if inherited is not None:
            carriers[path] = inherited
        if prim.IsA(UsdGeom.Gprim) and not is_site(prim):
            piece = _piece(stage, links.owner(path), prim, carrier)
            if piece is not None:
                pieces.append(piece)
                points += piece.shape.points
                require_size(len(pieces), MOST_SHAPES, "shapes", key=piece.path)
                require_size(points, MOST_POINTS, "points and triangles of meshes", key=piece.path)
    return pieces


def _piece(stage: Stage, link: Link | None, prim: Usd.Prim, carrier: Usd.Prim | None) -> Piece | None:
    solid = carrier is not None and stage.ledger.read(carrier, "physics:collisionEnabled", "the choice of colliders")
    collides = carrier is not None and solid is not False
    imageable = UsdGeom.Imageable(prim)
    drawn = imageable.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
    drawn = drawn and bool(imageable.ComputeVisibility() != UsdGeom.Tokens.invisible)
    if carrier is None and not drawn:
        stage.ledger.leave(prim.GetPath(), str(prim.GetTypeName()), "neither drawn nor solid")
        return None
    inside = link.frame.inverse().matrix() @ stage.matrix(prim) if link else stage.matrix(prim)
    shape = shape_of(prim, inside)
    reason = ""
    if shape is not None:
        require_near(shape.size if shape.vertices is None else shape.vertices, key=str(prim.GetPath()))
        if carrier is not None:
            shape = _approximated(stage, prim, carrier, shape, link is None)
            stage.ledger.mapped(carrier.GetPath(), "PhysicsCollisionAPI", "colliders")
        elif shape.vertices is not None and shape.faces is None:  # Mesh points without faces define a convex hull.
            shape = flat_to_box(shape)
        if shape.kind == "plane" and (link is not None or carrier is None):
            shape = None if collides else plane_as_box(prim, inside)
            reason = "a plane collides only where it stands still, in the world"
    if shape is None or (shape.kind != "plane" and any(size <= 0 for size in shape.size)):
        reason = "its size is zero" if shape else reason
        kind = str(prim.GetTypeName())
        if not reason:
            reason = "it has no valid triangles" if kind in SHAPED else "this kind of shape is not supported"
        stage.ledger.leave(prim.GetPath(), kind, reason)
        if collides:
            stage.ledger.warn(f"{prim.GetPath()}: a collider was left out: {reason} ({kind})")
        return None
    if shape.note:
        stage.ledger.assume(prim.GetPath(), f"{prim.GetTypeName()}: {shape.note}", shape.kind)
    if not collides and carrier is not None:
        stage.ledger.assume(prim.GetPath(), "collisionEnabled is 0: no contact, but it counts for the mass", "visual")
    return Piece(prim, link, shape, carrier, collides, drawn)


def _approximated(stage: Stage, prim: Usd.Prim, carrier: Usd.Prim, shape: Shape, static: bool) -> Shape:
    """Return a mesh's collision shape, such as a bounding box. MuJoCo uses the convex hull of a mesh for collisions."""
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
