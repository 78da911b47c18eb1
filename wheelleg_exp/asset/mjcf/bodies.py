"""Prints the tree of bodies with their joints, sites and shapes."""

from __future__ import annotations

from collections.abc import Iterator

from wheelleg_exp.asset.description import Body, Closure, Dof, Geom, Pose, RobotDescription, Site
from wheelleg_exp.asset.mjcf import attributes as of
from wheelleg_exp.asset.mjcf.attributes import Attributes
from wheelleg_exp.asset.mjcf.classes import Classes
from wheelleg_exp.asset.mjcf.notes import Notes
from wheelleg_exp.asset.mjcf.xml import Element
from wheelleg_exp.asset.naming import Numbered


class Names:
    """Names that clash with no other of the robot's."""

    def __init__(self, robot: RobotDescription) -> None:
        joints = Numbered(dof.name for dof in robot.dofs)
        sites = Numbered(s.name for s in (*robot.static_sites, *(s for body in robot.bodies for s in body.sites)))
        equalities = Numbered(coupling.name for coupling in robot.couplings)
        self._free = {body.name: joints.take(f"{body.name}_free") for body in robot.bodies if body.floating}
        self._closures: dict[str, list[tuple[str, str, str]]] = {}
        self._anchors: dict[str | None, list[tuple[str, Pose]]] = {}
        for closure in robot.closures:
            self._closure(closure, sites, equalities)

    def free_joint(self, body: str) -> str:
        """Return the name of a body's free joint."""
        return self._free[body]

    def anchors(self, body: str | None) -> Iterator[tuple[str, Pose]]:
        """Yield the sites on a body (None: the world) that loops close at."""
        yield from self._anchors.get(body, [])

    def equalities(self, closure: Closure) -> list[tuple[str, str, str]]:
        """Return for each pair of anchors the equality's name and its two sites."""
        return self._closures[closure.name]

    def _closure(self, closure: Closure, sites: Numbered, equalities: Numbered) -> None:
        made = self._closures.setdefault(closure.name, [])
        several = len(closure.anchors) > 1
        for index, pair in enumerate(closure.anchors):
            stem = f"{closure.name}_{index}"
            name = equalities.take(stem if several else closure.name)
            ends = [sites.take(f"{stem}_{side}") for side in "ab"]
            for body, site, at in zip(closure.bodies, ends, pair, strict=True):
                self._anchors.setdefault(body, []).append((site, at))
            made.append((name, ends[0], ends[1]))


class World:
    """Makes the ``<worldbody>`` of one robot."""

    def __init__(self, robot: RobotDescription, classes: Classes, names: Names, notes: Notes) -> None:
        self.robot, self.classes, self.names, self.notes = robot, classes, names, notes

    def element(self) -> Element:
        """Return the world with everything in it."""
        world = Element("worldbody")
        for geom in self.robot.static_geoms:
            self._geom(world, geom, static=True)
        self._sites(world, self.robot.static_sites, None)
        made: dict[str | None, Element] = {None: world}
        for body in self.robot.bodies:  # parents stand before their children
            made[body.name] = self._body(made[body.parent], body)
        return world

    def _body(self, parent: Element, body: Body) -> Element:
        hands_down = body.parent is None and self.classes.inherited()
        out = parent.add("body", name=body.name, childclass=self.classes.root if hands_down else None)
        out.attributes.update(of.pose(body.pose))
        out.attributes.update(mocap=True if body.mocap else None, gravcomp=1.0 if body.weightless else None)
        out.attributes.update(body.extra)
        self.notes.place(body.path, out)
        self._inertial(out, body)
        if body.floating:
            out.add("freejoint", name=self.names.free_joint(body.name))
        for dof in body.dofs:
            self._joint(out, dof)
        self._sites(out, body.sites, body.name)
        for geom in body.geoms:
            self._geom(out, geom)
        return out

    def _inertial(self, out: Element, body: Body) -> None:
        inertial = body.inertial
        turned = None if inertial.axes == of.IDENTITY else inertial.axes
        out.add(
            "inertial",
            pos=inertial.center_of_mass,
            quat=turned,
            mass=inertial.mass,
            diaginertia=inertial.moments,
        )

    def _joint(self, out: Element, dof: Dof) -> None:
        element = out.add(
            "joint",
            self.classes.rest("joint", dof.name),
            name=dof.name,
            class_=self.classes.of("joint", dof.name),
            type=None if dof.kind == "hinge" else dof.kind,
            pos=dof.anchor if any(dof.anchor) else None,
            axis=None if dof.kind == "ball" else dof.axis,
            range=dof.range,
            ref=dof.ref or None,
        )
        self.notes.place(dof.path, element)

    def _sites(self, out: Element, sites: tuple[Site, ...], owner: str | None) -> None:
        for site in sites:
            shared = self.classes.explicit("site", site.name) if owner is None else self.classes.of("site", site.name)
            rest = self.classes.rest("site", site.name)
            element = out.add("site", {**of.pose(site.pose), **rest}, name=site.name, class_=shared)
            self.notes.place(site.path, element)
        for name, at in self.names.anchors(owner):
            out.add("site", of.pose(at), name=name)

    def _geom(self, out: Element, geom: Geom, static: bool = False) -> None:
        bare = static and geom.collides  # what stands in the world keeps MuJoCo's own defaults
        rest: Attributes = of.geom(geom, static) if bare else self.classes.rest("geom", geom.name)
        element = out.add(
            "geom",
            {**of.pose(geom.pose), **{key: value for key, value in rest.items() if key != "type"}},
            name=geom.name,
            class_=None if bare else self.classes.of("geom", geom.name),
            type=rest.get("type"),
            size=geom.size or None,
            mesh=geom.mesh,
        )
        self.notes.place(geom.path, element)
