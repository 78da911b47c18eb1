"""Puts the readers of MuJoCo's schemas together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol, TypeVar

from wheelleg_exp.asset.description import Actuator, Body, Coupling, Dof, Geom, RobotDescription, Site, Tendon
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Links
from wheelleg_exp.asset.usd.mjc import equalities, geoms, joints
from wheelleg_exp.asset.usd.mjc.actuators import Targets, read_actuators
from wheelleg_exp.asset.usd.mjc.keyframes import read_keyframes
from wheelleg_exp.asset.usd.mjc.options import with_options
from wheelleg_exp.asset.usd.mjc.tendons import read_tendons, with_wraps
from wheelleg_exp.asset.usd.shapes.sites import world_sites
from wheelleg_exp.asset.usd.stage import Stage


def with_mujoco(stage: Stage, links: Links, robot: RobotDescription) -> RobotDescription:
    """Return the robot with everything that MuJoCo's schemas say, found by the paths of its parts.

    Args:
        stage: the open stage.
        links: its bodies.
        robot: what the other schemas say.
    """
    known = [*robot.static_sites, *(site for body in robot.bodies for site in body.sites)]
    robot = replace(robot, static_sites=(*robot.static_sites, *distinct(known, world_sites(stage, links))))
    robot = with_wraps(stage, links, robot)
    robot = _with_extras(stage, robot)
    dofs = single_dofs(robot)
    names = {path: dof.name for path, dof in dofs.items()}
    sites = {site.path: site.name for body in robot.bodies for site in body.sites}
    sites |= {site.path: site.name for site in robot.static_sites}
    shapes = {geom.path: geom.name for geom in _all_geoms(robot)}
    tendons = distinct(robot.tendons, read_tendons(stage, names, sites, shapes))
    ranged = {dof.name for dof in robot.dofs if dof.range} | {t.name for t in (*robot.tendons, *tendons) if t.range}
    targets = Targets(
        ranged=ranged,
        joints=names,
        tendons={tendon.path: tendon.name for tendon in tendons},
        sites=sites,
        bodies={body.path: body.name for body in robot.bodies},
    )
    couplings = distinct(robot.couplings, equalities.read_couplings(stage, dofs))
    robot = replace(
        robot,
        tendons=(*robot.tendons, *tendons),
        couplings=(*robot.couplings, *couplings),
        actuators=(*robot.actuators, *read_actuators(stage, targets)),
    )
    robot = _without_doubled_drives(stage, robot)
    robot = replace(robot, actuators=distinct([dof for dof in robot.dofs if dof.drive], robot.actuators))
    robot = with_options(stage, robot)
    return replace(robot, keyframes=(*robot.keyframes, *read_keyframes(stage, robot)))


class _Named(Protocol):
    @property
    def name(self) -> str: ...


Part = TypeVar("Part", Site, Tendon, Coupling, Actuator)


def distinct(known: Iterable[_Named], parts: Iterable[Part]) -> tuple[Part, ...]:
    """Return ``parts`` with numbers behind the names that ``known`` parts of the same kind have already."""
    taken, out = {item.name for item in known}, []
    for part in parts:
        name, number = part.name, 2
        while name in taken:
            name, number = f"{part.name}_{number}", number + 1
        taken.add(name)
        out.append(part if name == part.name else replace(part, name=name))
    return tuple(out)


def single_dofs(robot: RobotDescription) -> dict[str, Dof]:
    """Return by prim path the degrees of freedom of joints that have just one."""
    found: dict[str, Dof | None] = {}
    for dof in robot.dofs:
        found[dof.path] = None if dof.path in found else dof
    return {path: dof for path, dof in found.items() if dof is not None}


def _all_geoms(robot: RobotDescription) -> list[Geom]:
    return [*robot.static_geoms, *(geom for body in robot.bodies for geom in body.geoms)]


def _with_extras(stage: Stage, robot: RobotDescription) -> RobotDescription:
    hulls = {g.mesh: found for g in _all_geoms(robot) if g.mesh and (found := geoms.hull_size(stage, g))}
    return replace(
        robot,
        bodies=tuple(_body(stage, body) for body in robot.bodies),
        static_geoms=tuple(geoms.with_extra(stage, geom) for geom in robot.static_geoms),
        closures=tuple(equalities.with_extra(stage, closure) for closure in robot.closures),
        meshes=tuple(replace(m, extra={**m.extra, **hulls[m.name]}) if m.name in hulls else m for m in robot.meshes),
    )


def _body(stage: Stage, body: Body) -> Body:
    body = joints.with_extra(stage, body)
    return replace(body, geoms=tuple(geoms.with_extra(stage, geom) for geom in body.geoms))


def _without_doubled_drives(stage: Stage, robot: RobotDescription) -> RobotDescription:
    """Drop the drive of a joint that an actuator of MuJoCo's own acts on."""
    driven = {item.target for item in robot.actuators if item.transmission in ("joint", "jointinparent")}
    bodies = []
    for body in robot.bodies:
        dofs = tuple(replace(d, drive=None) if d.drive and d.name in driven else d for d in body.dofs)
        for old, new in zip(body.dofs, dofs, strict=True):
            if old is not new:
                _leave_drive(stage, old)
        bodies.append(replace(body, dofs=dofs) if dofs != body.dofs else body)
    return replace(robot, bodies=tuple(bodies))


def _leave_drive(stage: Stage, dof: Dof) -> None:
    prim = stage.usd.GetPrimAtPath(dof.path)
    for prop in prim.GetAuthoredPropertiesInNamespace("drive"):
        stage.ledger.leave(dof.path, prop.GetName(), "a MjcActuator acts on this joint and wins over its drive")
