"""Reads MjcTendon prims: fixed ones over joints, spatial ones through sites, around geoms and over pulleys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pxr import Usd

from wheelleg_exp.asset.description import Geom, RobotDescription, Tendon, TendonPoint
from wheelleg_exp.asset.naming import Numbered, unique_names
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Links, shown_names
from wheelleg_exp.asset.usd.mjc.values import Attribute, attributes, indices, leave, limits, numbers
from wheelleg_exp.asset.usd.shapes.gprims import shape_of
from wheelleg_exp.asset.usd.shapes.sites import is_site
from wheelleg_exp.asset.usd.stage import Stage

KIND = "MjcTendon"
NAMES = {
    f"mjc:{name}": name
    for name in (
        "springlength",
        "stiffness",
        "damping",
        "frictionloss",
        "armature",
        "margin",
        "solreflimit",
        "solimplimit",
        "solreffriction",
        "solimpfriction",
        "group",
    )
}
DRAWN = {"mjc:width": "width", "mjc:rgba": "rgba"}  # only spatial tendons are drawn
OF_SPATIAL = (*DRAWN, "mjc:path:segments", "mjc:path:divisors", "mjc:sideSites:indices")


def tendon_prims(stage: Stage) -> list[Usd.Prim]:
    """Return the tendons of the stage."""
    return [prim for prim in stage.prims if prim.GetTypeName() == KIND]


def read_tendons(
    stage: Stage, joints: Mapping[str, str], sites: Mapping[str, str], geoms: Mapping[str, str]
) -> tuple[Tendon, ...]:
    """Return the tendons whose whole path is in the model; the arguments map prim paths to names there."""
    prims = tendon_prims(stage)
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    found = (_tendon(stage, prim, names[str(prim.GetPath())], joints, sites, geoms) for prim in prims)
    return tuple(tendon for tendon in found if tendon is not None)


def _tendon(
    stage: Stage,
    prim: Usd.Prim,
    name: str,
    joints: Mapping[str, str],
    sites: Mapping[str, str],
    geoms: Mapping[str, str],
) -> Tendon | None:
    fixed = stage.ledger.read(prim, "mjc:type", "fixed or spatial") == "fixed"
    try:
        factors = _factors(stage, prim, joints) if fixed else ()
        points = () if fixed else _points(stage, prim, sites, geoms)
    except _BrokenPath as error:
        stage.ledger.leave(prim.GetPath(), KIND, str(error))
        stage.ledger.warn(f"{prim.GetPath()}: this tendon was left out: {error}")
        return None
    extra = attributes(stage, prim, NAMES | ({} if fixed else DRAWN))
    for other in OF_SPATIAL if fixed else ("mjc:path:coef",):
        leave(stage, prim, other, "only spatial tendons have it" if fixed else "only fixed tendons have it")
    bounds = limits(stage, prim, "mjc:range", "mjc:limited", "range")
    extra |= limits(stage, prim, "mjc:actuatorfrcrange", "mjc:actuatorfrclimited", "actuatorfrcrange")
    extra |= {key: value for key, value in bounds.items() if key != "range"}
    stage.ledger.mapped(prim.GetPath(), KIND, f"tendon {name}")
    return Tendon(name, str(prim.GetPath()), points, factors, _pair(bounds.get("range")), extra)


class _BrokenPath(Exception):
    """A path that cannot be followed, with the reason."""


def _pair(value: Attribute | None) -> tuple[float, float] | None:
    return (value[0], value[1]) if isinstance(value, tuple) else None


def _route(stage: Stage, prim: Usd.Prim) -> list[str]:
    """Return the prim paths of a tendon's stations, in order."""
    targets = [str(path) for path in stage.ledger.targets(prim, "mjc:path", "the tendon's path")]
    order = indices(stage, prim, "mjc:path:indices", "the tendon's path") or list(range(len(targets)))
    if not order or not all(0 <= i < len(targets) for i in order):
        raise _BrokenPath("its path and the indices into it do not fit")
    return [targets[i] for i in order]


def _factors(stage: Stage, prim: Usd.Prim, joints: Mapping[str, str]) -> tuple[tuple[str, float], ...]:
    route = _route(stage, prim)
    factors = numbers(stage, prim, "mjc:path:coef", "the tendon's coefficients") or ()
    if len(factors) != len(route):
        raise _BrokenPath(f"it has {len(route)} joints, but {len(factors)} coefficients")
    missing = [path for path in route if path not in joints]
    if missing:
        raise _BrokenPath(f"there is no joint '{missing[0]}' in the model")
    return tuple((joints[path], factor) for path, factor in zip(route, factors, strict=True))


def _points(
    stage: Stage, prim: Usd.Prim, sites: Mapping[str, str], geoms: Mapping[str, str]
) -> tuple[TendonPoint, ...]:
    route = _route(stage, prim)
    segments = indices(stage, prim, "mjc:path:segments", "the tendon's pulleys") or [0] * len(route)
    divisors = numbers(stage, prim, "mjc:path:divisors", "the tendon's pulleys") or (1.0,)
    sides = _sides(stage, prim, len(route), sites)
    if len(segments) != len(route) or max(segments) >= len(divisors):
        raise _BrokenPath("its path and its segments do not fit")
    points: list[TendonPoint] = []
    current = 0
    for path, segment, side in zip(route, segments, sides, strict=True):
        if segment != current or (not points and divisors[0] != 1.0):
            points.append(TendonPoint("pulley", divisor=divisors[segment]))
        current = segment
        points.append(_point(path, side, sites, geoms))
    return tuple(points)


def _point(path: str, side: str | None, sites: Mapping[str, str], geoms: Mapping[str, str]) -> TendonPoint:
    if path in sites:
        return TendonPoint("site", sites[path])
    if path in geoms:
        return TendonPoint("geom", geoms[path], side)
    raise _BrokenPath(f"there is no site or geom '{path}' in the model")


def _sides(stage: Stage, prim: Usd.Prim, count: int, sites: Mapping[str, str]) -> list[str | None]:
    """Return each station's side site, or None."""
    targets = [str(path) for path in stage.ledger.targets(prim, "mjc:sideSites", "the tendon's side sites")]
    order = indices(stage, prim, "mjc:sideSites:indices", "the tendon's side sites") or [-1] * count
    if len(order) != count or max(order) >= len(targets):
        raise _BrokenPath("its path and its side sites do not fit")
    missing = [path for path in targets if path not in sites]
    if missing:
        raise _BrokenPath(f"there is no site '{missing[0]}' in the model")
    return [sites[targets[i]] if i >= 0 else None for i in order]


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
