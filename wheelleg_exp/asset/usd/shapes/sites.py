"""Reads named frames: Isaac's sensors, and the sites of MuJoCo's and Newton's schemas with their looks."""

from __future__ import annotations

from pxr import Usd, UsdGeom

from wheelleg_exp.asset.description import Extra, Site
from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links, shown_names
from wheelleg_exp.asset.usd.shapes.gprims import shape_of
from wheelleg_exp.asset.usd.shapes.materials import display_color
from wheelleg_exp.asset.usd.stage import Stage, schemas

SITE_SCHEMAS = {"MjcSiteAPI", "NewtonSiteAPI"}
SHAPES = {"sphere", "capsule", "ellipsoid", "cylinder", "box"}  # what MuJoCo draws sites as
GREY = (0.5, 0.5, 0.5, 1.0)  # the colour of a site without any
SAME_ANGLE = 1e-6  # rad between a shape's frame and its prim's


def is_site(prim: Usd.Prim) -> bool:
    """Return whether a prim marks a place and is neither drawn nor solid."""
    kind = str(prim.GetTypeName())
    return (kind.startswith("Isaac") and kind.endswith("Sensor")) or bool(SITE_SCHEMAS & set(schemas(prim)))


def find_sites(stage: Stage, links: Links) -> dict[str, list[Site]]:
    """Return the sites of each body, by the body's path.

    The USD library does not know the types of Isaac's sensors, so that their own transform is that of the prim above.
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
    """Return a site's shape, size, colour and group, where the prim is a shape that MuJoCo draws there."""
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
