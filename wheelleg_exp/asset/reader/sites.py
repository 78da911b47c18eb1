"""Reads named frames on bodies: Isaac's sensors, and the sites of MuJoCo's and Newton's schemas."""

from __future__ import annotations

from pxr import Usd

from wheelleg_exp.asset.description import Site
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.reader.bodies import Links, shown_names
from wheelleg_exp.asset.reader.stage import Stage, schemas

SITE_SCHEMAS = {"MjcSiteAPI", "NewtonSiteAPI"}


def is_site(prim: Usd.Prim) -> bool:
    """Return whether a prim marks a place and is neither drawn nor solid."""
    kind = str(prim.GetTypeName())
    return (kind.startswith("Isaac") and kind.endswith("Sensor")) or bool(SITE_SCHEMAS & set(schemas(prim)))


def find_sites(stage: Stage, links: Links) -> dict[str, list[Site]]:
    """Return the sites of each body, by the body's path.

    The USD library does not know the types of Isaac's sensors, so that their own transform is that of the prim above.
    """
    prims = [prim for prim in stage.prims if is_site(prim)]
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    found: dict[str, list[Site]] = {}
    for prim in prims:
        link, path = links.owner(prim.GetPath()), str(prim.GetPath())
        if link is None:
            stage.ledger.leave(path, str(prim.GetTypeName()), "a site of the world is not read")
            continue
        stage.ledger.mapped(path, str(prim.GetTypeName()), f"site {names[path]}")
        pose = (link.frame.inverse() @ stage.frame(prim)).pose()
        found.setdefault(link.path, []).append(Site(names[path], path, pose))
    return found
