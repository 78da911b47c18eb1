"""Makes geoms of the shapes that tendons wrap around and that nothing else needs: neither drawn nor solid."""

from __future__ import annotations

from dataclasses import replace

from pxr import Usd

from wheelleg_exp.asset.description import Geom, RobotDescription
from wheelleg_exp.asset.naming import Numbered, unique_names
from wheelleg_exp.asset.reader.bodies import Links, shown_names
from wheelleg_exp.asset.reader.mujoco.tendons import tendon_prims
from wheelleg_exp.asset.reader.shapes import shape_of
from wheelleg_exp.asset.reader.sites import is_site
from wheelleg_exp.asset.reader.stage import Stage

WRAPPED = {"sphere", "cylinder"}  # what MuJoCo's tendons go around


def with_wraps(stage: Stage, links: Links, robot: RobotDescription) -> RobotDescription:
    """Return the robot with a geom for each shape on a tendon's path that it has no geom of yet."""
    known = {g.path for g in robot.static_geoms} | {g.path for body in robot.bodies for g in body.geoms}
    prims = [prim for prim in _wrapped(stage) if str(prim.GetPath()) not in known]
    geoms = [*robot.static_geoms, *(geom for body in robot.bodies for geom in body.geoms)]
    taken = Numbered(geom.name for geom in geoms)
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    added: dict[str | None, list[Geom]] = {}
    for prim in prims:
        link = links.owner(prim.GetPath())
        inside = link.frame.inverse().matrix() @ stage.matrix(prim) if link else stage.matrix(prim)
        shape = shape_of(prim, inside)
        if shape is None or shape.kind not in WRAPPED:
            continue
        path = str(prim.GetPath())
        name = taken.take(names[path])
        stage.ledger.mapped(path, str(prim.GetTypeName()), f"geom {name}, which tendons wrap around")
        geom = Geom(name, path, shape.kind, shape.size, shape.frame.pose(), collides=False, drawn=False)
        added.setdefault(link.path if link else None, []).append(geom)
    if not added:
        return robot
    bodies = tuple(replace(b, geoms=(*b.geoms, *added[b.path])) if b.path in added else b for b in robot.bodies)
    return replace(robot, bodies=bodies, static_geoms=(*robot.static_geoms, *added.get(None, [])))


def _wrapped(stage: Stage) -> list[Usd.Prim]:
    """Return the prims on tendons' paths that are no sites and no joints, each once."""
    found: dict[str, Usd.Prim] = {}
    for tendon in tendon_prims(stage):
        for path in stage.ledger.targets(tendon, "mjc:path"):
            prim = stage.usd.GetPrimAtPath(path)
            if prim and not is_site(prim):
                found[str(path)] = prim
    return list(found.values())
