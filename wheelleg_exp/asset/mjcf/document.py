"""Prints a robot description as MJCF, for people to read and keep."""

from __future__ import annotations

import re
from collections.abc import Sequence

from wheelleg_exp.asset.description import Dof, Mesh, RobotDescription, Tendon
from wheelleg_exp.asset.mjcf import attributes as of
from wheelleg_exp.asset.mjcf.attributes import IDENTITY
from wheelleg_exp.asset.mjcf.bodies import Names, World
from wheelleg_exp.asset.mjcf.classes import gather
from wheelleg_exp.asset.mjcf.notes import Note, Notes
from wheelleg_exp.asset.mjcf.xml import Element
from wheelleg_exp.errors import AssetError


def file_name(mesh: Mesh) -> str:
    """Return the mesh's file name: its own, without what file systems take for folders."""
    return re.sub(r"[^\w.-]", "_", mesh.name) + ".obj"


def obj_text(mesh: Mesh) -> str:
    """Return the mesh as OBJ, every number without loss."""
    points = ["v %r %r %r" % (x, y, z) for x, y, z in mesh.vertices.tolist()]  # noqa: UP031 (twice as fast)
    faces = ["f %d %d %d" % (a, b, c) for a, b, c in (mesh.faces + 1).tolist()]  # noqa: UP031
    return "\n".join([*points, *faces]) + "\n"


SHOWN_NOTES = 30  # assumptions in the file's head; all of them are in the report
DEEPEST = 499  # nested elements that MuJoCo's XML reader takes


class Writer:
    """Makes the document of one robot."""

    def __init__(self, robot: RobotDescription, mesh_folder: str, notes: Sequence[Note] = ()) -> None:
        self.robot, self.mesh_folder = robot, mesh_folder
        self.notes = Notes(notes)
        self.names = Names(robot)
        self.classes = gather(robot)

    def text(self) -> str:
        """Return the whole document.

        Raises:
            AssetError: bodies are nested deeper than MuJoCo reads.
        """
        root = Element("mujoco", {"model": self.robot.name})
        self._settings(root)
        world = World(self.robot, self.classes, self.names, self.notes).element()
        parts = (self.classes.element(), self._assets(), world, self._contacts(), self._equalities())
        for element in (*parts, self._tendons(), self._actuators(), keyframes(self.robot)):
            if element.children:
                root.children.append(element)
        self._check_depth(root)
        root.comment = "\n".join(self._head(self.notes.write()))
        return root.text() + "\n"

    def _head(self, notes: list[str]) -> list[str]:
        lines = [f"{self.robot.name}: SI units, radians, z up. Converted by 'wheelleg convert'."]
        if notes:
            lines += ["Assumed:", *(f"  {note}" for note in notes[:SHOWN_NOTES])]
        if len(notes) > SHOWN_NOTES:
            lines.append(f"  and {len(notes) - SHOWN_NOTES} more, in the report")
        return lines

    def _check_depth(self, root: Element) -> None:
        if (depth := root.depth()) > DEEPEST:
            raise AssetError(
                f"'{self.robot.name}' has a chain of about {depth - 3} bodies",
                expected=f"no more than {DEEPEST - 3}, which is what MuJoCo reads from a file",
            )

    def _settings(self, root: Element) -> None:
        files = any(len(mesh.faces) for mesh in self.robot.meshes)
        folder = self.mesh_folder if files else None
        root.add("compiler", self.robot.compiler, angle="radian", autolimits=True, meshdir=folder)
        option = root.add("option", self.robot.option, gravity=self.robot.gravity)
        if self.robot.flag:
            option.add("flag", self.robot.flag)

    def _assets(self) -> Element:
        out = Element("asset")
        for item in self.robot.materials:
            out.add("material", name=item.name, rgba=item.rgba, metallic=item.metallic, roughness=item.roughness)
        for mesh in self.robot.meshes:
            out.children.append(_mesh(mesh))
        return out

    def _contacts(self) -> Element:
        out = Element("contact")
        for first, second in self.robot.exclusions:
            out.add("exclude", body1=first, body2=second)
        return out

    def _equalities(self) -> Element:
        out = Element("equality")
        for closure in self.robot.closures:
            extra = {key: value for key, value in closure.extra.items() if key == "torquescale"}
            for name, first, second in self.names.equalities(closure):
                own = {**extra, **self.classes.rest("equality", of.key(closure))}
                shared = self.classes.explicit("equality", of.key(closure))
                element = out.add(closure.kind, own, name=name, class_=shared, site1=first, site2=second)
                self.notes.place(closure.path, element)
        for item in self.robot.couplings:
            out.add(
                "joint",
                self.classes.rest("equality", of.key(item)),
                name=item.name,
                class_=self.classes.explicit("equality", of.key(item)),
                joint1=item.joint,
                joint2=item.reference,
                polycoef=item.coefficients,
            )
        return out

    def _tendons(self) -> Element:
        out = Element("tendon")
        for tendon in self.robot.tendons:
            shared = self.classes.explicit("tendon", tendon.name)
            element = out.add(
                "fixed" if tendon.joints else "spatial",
                self.classes.rest("tendon", tendon.name),
                name=tendon.name,
                class_=shared,
            )
            self.notes.place(tendon.path, element)
            _route(element, tendon)
        return out

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
            element.attributes[item.transmission] = item.target
            element.attributes.update({k: item.extra[k] for k in ("refsite", "slidersite") if k in item.extra})
            element.attributes.update(self.classes.rest("general", item.name))
            self.notes.place(item.path, element)
        return out


def _route(element: Element, tendon: Tendon) -> None:
    for joint, factor in tendon.joints:
        element.add("joint", joint=joint, coef=factor)
    for point in tendon.points:
        if point.kind == "pulley":
            element.add("pulley", divisor=point.divisor)
        else:
            element.add(point.kind, {point.kind: point.name, "sidesite": point.side})


def _mesh(mesh: Mesh) -> Element:
    inertia = "convex" if mesh.solid else "shell"
    own: of.Attributes = {"vertex": mesh.vertices.ravel()} if not len(mesh.faces) else {"file": file_name(mesh)}
    return Element("mesh", {"name": mesh.name, **own, "inertia": inertia, **mesh.extra})


HOME = "home"


def keyframes(robot: RobotDescription) -> Element:
    """Return the ``<keyframe>`` of a robot; a keyframe of the file called ``home`` takes the place of ours."""
    out = Element("keyframe")
    positions, velocities = state(robot)
    controls = [_control(dof) for dof in robot.dofs if dof.drive] + [0.0] * len(robot.actuators)
    if positions and all(item.name != HOME for item in robot.keyframes):
        out.add(
            "key",
            name=HOME,
            qpos=positions,
            qvel=velocities if any(velocities) else None,
            ctrl=controls if any(controls) else None,
        )
    for item in robot.keyframes:
        out.add("key", item.extra, name=item.name)
    return out


def state(robot: RobotDescription) -> tuple[list[float], list[float]]:
    """Return qpos and qvel: the saved state, floating bases where they are drawn."""
    positions: list[float] = []
    velocities: list[float] = []
    for body in robot.bodies:
        if body.floating:
            positions += [*body.pose.position, *body.pose.rotation]
            velocities += body.velocity
        for dof in body.dofs:
            positions += IDENTITY if dof.kind == "ball" else (dof.position,)
            velocities += [0.0] * 3 if dof.kind == "ball" else [dof.velocity]
    return positions, velocities


def _control(dof: Dof) -> float:
    assert dof.drive is not None
    return {"position": dof.drive.target_position, "velocity": dof.drive.target_velocity, "motor": 0.0}[dof.drive.kind]
