"""Print a robot description as MJCF for people to read; an assumption is a comment at its element, or in the head."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from wheelleg_exp.asset import robot_description as desc
from wheelleg_exp.asset.conversion_report import Assumption
from wheelleg_exp.asset.mjcf import mjcf_elements as of
from wheelleg_exp.asset.mjcf.default_classes import gather
from wheelleg_exp.asset.mjcf.mjcf_elements import IDENTITY, Attributes, Element
from wheelleg_exp.errors import AssetError

FEW = 6  # comments of one rule


class Notes:
    """The converter's assumptions, which become XML comments at the MJCF elements to which they apply."""

    def __init__(self, notes: Sequence[Assumption]) -> None:
        self._notes = notes
        self._elements: dict[str, Element] = {}

    def place(self, path: str, element: Element) -> None:
        """Remember the first MJCF element that is made from the robot file's element ``path``."""
        if path:
            self._elements.setdefault(path, element)

    def write(self) -> list[str]:
        """Add the converter's assumptions as comments to MJCF elements; return comments for the head of the MJCF."""
        rules = Counter(note.rule for note in self._notes)
        many = {rule: count for rule, count in rules.items() if count > FEW}
        head = [f"{rule} ({count} places)" for rule, count in many.items()]
        for note in self._notes:
            if note.rule in many:
                continue
            text = f"{note.rule}: {note.value}" if note.value else note.rule
            path = note.path
            while path.strip("/") and path not in self._elements:
                path = path.rpartition("/")[0]
            element = self._elements.get(path)
            if element is None:
                head.append(f"{note.path}: {text}")
            elif text not in element.comment:
                element.comment = f"{element.comment}; {text}" if element.comment else text
        return head


class Names:
    """The unique names of the free joints, loop closures, and anchor sites of an MJCF."""

    def __init__(self, robot: desc.RobotDescription) -> None:
        joints = desc.Numbered(dof.name for dof in robot.dofs)
        sites = desc.Numbered(site.name for site in robot.sites)
        equalities = desc.Numbered(coupling.name for coupling in robot.couplings)
        self.free_joints = {body.name: joints.take(f"{body.name}_free") for body in robot.bodies if body.floating}
        self.equalities: dict[str, list[tuple[str, str, str]]] = {}
        self.anchors: dict[str | None, list[tuple[str, desc.Pose]]] = {}
        # MuJoCo closes a loop of bodies by an equality constraint between two sites, one on each of two bodies.
        for closure in robot.closures:
            made = self.equalities.setdefault(closure.name, [])
            several = len(closure.anchors) > 1
            for index, pair in enumerate(closure.anchors):
                stem = f"{closure.name}_{index}"
                name = equalities.take(stem if several else closure.name)
                ends = [sites.take(f"{stem}_{side}") for side in "ab"]
                for body, site, at in zip(closure.bodies, ends, pair, strict=True):
                    self.anchors.setdefault(body, []).append((site, at))
                made.append((name, ends[0], ends[1]))


def file_name(mesh: desc.Mesh) -> str:
    """Return the name of a mesh's OBJ file, with slashes and other special characters replaced by ``_``."""
    return re.sub(r"[^\w.-]", "_", mesh.name) + ".obj"


def obj_text(mesh: desc.Mesh) -> str:
    """Return a mesh as OBJ text with exact numbers; formatting with ``%`` is much faster here than f-strings."""
    points = ["v %r %r %r" % (x, y, z) for x, y, z in mesh.vertices.tolist()]  # noqa: UP031
    faces = ["f %d %d %d" % (a, b, c) for a, b, c in (mesh.faces + 1).tolist()]  # noqa: UP031
    return "\n".join([*points, *faces]) + "\n"


SHOWN_NOTES = 30  # assumptions in the head
DEEPEST = 499  # levels of nested elements


class Writer:
    """The MJCF document of one robot."""

    def __init__(self, robot: desc.RobotDescription, mesh_folder: str, notes: Sequence[Assumption] = ()) -> None:
        self.robot, self.mesh_folder = robot, mesh_folder
        self.notes = Notes(notes)
        self.names = Names(robot)
        self.classes = gather(robot)

    def text(self) -> str:
        root = Element("mujoco", {"model": self.robot.name})
        files = any(len(mesh.faces) for mesh in self.robot.meshes)
        folder = self.mesh_folder if files else None
        root.add("compiler", self.robot.compiler, angle="radian", autolimits=True, meshdir=folder)
        option = root.add("option", self.robot.option, gravity=self.robot.gravity)
        if self.robot.flag:
            option.add("flag", self.robot.flag)
        out = Element("asset")
        for item in self.robot.materials:
            out.add("material", name=item.name, rgba=item.rgba, metallic=item.metallic, roughness=item.roughness)
        for mesh in self.robot.meshes:
            inertia = "convex" if mesh.solid else "shell"
            own: Attributes = {"file": file_name(mesh)} if len(mesh.faces) else {"vertex": mesh.vertices.ravel()}
            out.children.append(Element("mesh", {"name": mesh.name, **own, "inertia": inertia, **mesh.extra}))
        world = Element("worldbody")
        for geom in self.robot.static_geoms:
            self._geom(world, geom, static=True)
        self._sites(world, self.robot.static_sites, None)
        made: dict[str | None, Element] = {None: world}
        for body in self.robot.bodies:  # ``robot.bodies`` lists each parent body before its children.
            made[body.name] = self._body(made[body.parent], body)
        contact = Element("contact")
        for first, second in self.robot.exclusions:
            contact.add("exclude", body1=first, body2=second)
        parts = (self.classes.element(), out, world, contact, *self._equalities_and_tendons())
        for element in (*parts, self._actuators(), keyframes(self.robot)):
            if element.children:
                root.children.append(element)
        if (depth := root.depth()) > DEEPEST:
            message = f"'{self.robot.name}' has a chain of about {depth - 3} bodies"
            raise AssetError(message, expected=f"at most {DEEPEST - 3}, MuJoCo's limit")
        notes = self.notes.write()
        lines = [f"{self.robot.name}: SI units, radians, z up. Converted by 'wheelleg convert'."]
        if notes:
            lines += ["Assumed:", *(f"  {note}" for note in notes[:SHOWN_NOTES])]
        if len(notes) > SHOWN_NOTES:
            lines.append(f"  and {len(notes) - SHOWN_NOTES} more, in the report")
        root.comment = "\n".join(lines)
        return root.text() + "\n"

    def _body(self, parent: Element, body: desc.Body) -> Element:
        passes_class = body.parent is None and self.classes.inherited()
        out = parent.add("body", name=body.name, childclass=self.classes.root if passes_class else None)
        out.attributes.update(of.pose(body.pose))
        out.attributes.update(mocap=True if body.mocap else None, gravcomp=1.0 if body.weightless else None)
        out.attributes.update(body.extra)
        self.notes.place(body.path, out)
        inertial = body.inertial
        turned = None if inertial.axes == IDENTITY else inertial.axes
        out.add("inertial", pos=inertial.center_of_mass, quat=turned, mass=inertial.mass, diaginertia=inertial.moments)
        if body.floating:
            out.add("freejoint", name=self.names.free_joints[body.name])
        for dof in body.dofs:
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
        self._sites(out, body.sites, body.name)
        for geom in body.geoms:
            self._geom(out, geom)
        return out

    def _sites(self, out: Element, sites: tuple[desc.Site, ...], owner: str | None) -> None:
        for site in sites:
            shared = self.classes.explicit("site", site.name) if owner is None else self.classes.of("site", site.name)
            rest = self.classes.rest("site", site.name)
            element = out.add("site", {**of.pose(site.pose), **rest}, name=site.name, class_=shared)
            self.notes.place(site.path, element)
        for name, at in self.names.anchors.get(owner, []):
            out.add("site", of.pose(at), name=name)

    def _geom(self, out: Element, geom: desc.Geom, static: bool = False) -> None:
        bare = static and geom.collides
        rest: Attributes = of.geom(geom, static) if bare else self.classes.rest("geom", geom.name)
        own = {**of.pose(geom.pose), **{key: value for key, value in rest.items() if key != "type"}}
        shared, kind = None if bare else self.classes.of("geom", geom.name), rest.get("type")
        element = out.add("geom", own, name=geom.name, class_=shared, type=kind, size=geom.size or None, mesh=geom.mesh)
        self.notes.place(geom.path, element)

    def _equalities_and_tendons(self) -> tuple[Element, Element]:
        equalities, tendons, classes = Element("equality"), Element("tendon"), self.classes
        for closure in self.robot.closures:
            extra = {key: value for key, value in closure.extra.items() if key == "torquescale"}
            own = {**extra, **classes.rest("equality", of.key(closure))}
            shared = classes.explicit("equality", of.key(closure))
            for name, first, second in self.names.equalities[closure.name]:
                element = equalities.add(closure.kind, own, name=name, class_=shared, site1=first, site2=second)
                self.notes.place(closure.path, element)
        for item in self.robot.couplings:
            rest, shared = classes.rest("equality", of.key(item)), classes.explicit("equality", of.key(item))
            ends: Attributes = {"joint1": item.joint, "joint2": item.reference, "polycoef": item.coefficients}
            equalities.add("joint", rest, name=item.name, class_=shared, **ends)
        for tendon in self.robot.tendons:
            rest, shared = classes.rest("tendon", tendon.name), classes.explicit("tendon", tendon.name)
            element = tendons.add("fixed" if tendon.joints else "spatial", rest, name=tendon.name, class_=shared)
            self.notes.place(tendon.path, element)
            for joint, factor in tendon.joints:
                element.add("joint", joint=joint, coef=factor)
            for point in tendon.points:
                if point.kind == "pulley":
                    element.add("pulley", divisor=point.divisor)
                else:
                    element.add(point.kind, {point.kind: point.name, "sidesite": point.side})
        return equalities, tendons

    def _actuators(self) -> Element:
        out = Element("actuator")
        for dof in self.robot.dofs:
            if dof.drive is None:
                continue
            kind = dof.drive.kind
            rest, shared = self.classes.rest(kind, dof.name), self.classes.explicit(kind, dof.name)
            element = out.add(kind, rest, name=dof.name, class_=shared, joint=dof.name)
            if dof.drive.acceleration:
                element.comment = "an acceleration drive: its gains times the inertia that it meets at zero"
        for item in self.robot.actuators:
            shared = self.classes.explicit("general", item.name)
            element = out.add("general", name=item.name, class_=shared)
            # The target attribute's name (``joint``, ``tendon``, ...) varies, so it cannot be a keyword argument.
            element.attributes[item.transmission] = item.target
            element.attributes.update({k: item.extra[k] for k in ("refsite", "slidersite") if k in item.extra})
            element.attributes.update(self.classes.rest("general", item.name))
            self.notes.place(item.path, element)
        return out


HOME = "home"


def keyframes(robot: desc.RobotDescription) -> Element:
    """Return the robot file's keyframes and, unless one is ``home``, the saved state with bases as drawn."""
    out = Element("keyframe")
    positions: list[float] = []
    velocities: list[float] = []
    for body in robot.bodies:
        if body.floating:
            positions += [*body.pose.position, *body.pose.rotation]
            velocities += body.velocity
        for dof in body.dofs:
            positions += IDENTITY if dof.kind == "ball" else (dof.position,)
            velocities += [0.0] * 3 if dof.kind == "ball" else [dof.velocity]
    drives = [dof.drive for dof in robot.dofs if dof.drive]
    targets = {"position": "target_position", "velocity": "target_velocity"}
    controls = [float(getattr(drive, targets[drive.kind])) if drive.kind in targets else 0.0 for drive in drives]
    controls += [0.0] * len(robot.actuators)
    if positions and all(item.name != HOME for item in robot.keyframes):
        moving, driven = velocities if any(velocities) else None, controls if any(controls) else None
        out.add("key", name=HOME, qpos=positions, qvel=moving, ctrl=driven)
    for item in robot.keyframes:
        out.add("key", item.extra, name=item.name)
    return out
