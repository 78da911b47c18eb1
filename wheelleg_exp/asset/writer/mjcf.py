"""Prints a robot description as MJCF, for people to read and keep."""

from __future__ import annotations

from wheelleg_exp.asset.description import Body, Dof, Geom, Mesh, Pose, Quat, RobotDescription, Vec3
from wheelleg_exp.asset.writer.classes import COLLISION, VISUAL, drive_attributes, group, joint_attributes
from wheelleg_exp.asset.writer.meshes import file_name
from wheelleg_exp.asset.writer.xml import Element, Value

IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)
SHOWN_NOTES = 30  # assumptions in the file's head; all of them are in the report
COLLIDER_COLOR = (0.2, 0.6, 0.3, 0.4)


class Writer:
    """Makes the document of one robot."""

    def __init__(self, robot: RobotDescription, mesh_folder: str, notes: list[str]) -> None:
        self.robot, self.mesh_folder, self.notes = robot, mesh_folder, notes
        self.groups = group(robot.dofs)
        self._class_of = {dof.name: name for name, members in self.groups.items() for dof in members}
        self._frictions = {geom.friction for geom in robot.colliders}

    def text(self) -> str:
        """Return the whole document."""
        root = Element("mujoco", {"model": self.robot.name}, comment="\n".join(self._head()))
        files = any(len(mesh.faces) for mesh in self.robot.meshes)
        root.add("compiler", angle="radian", autolimits=True, meshdir=self.mesh_folder if files else None)
        root.add("option", gravity=self.robot.gravity)
        parts = (self._defaults, self._assets, self._world, self._contacts, self._equalities, self._actuators)
        for part in (*parts, self._keyframe):
            element = part()
            if element.children:
                root.children.append(element)
        return root.text() + "\n"

    def _head(self) -> list[str]:
        lines = [f"{self.robot.name}: SI units, radians, z up. Converted from USD by 'wheelleg convert'."]
        if self.notes:
            lines += ["Assumed:", *(f"  {note}" for note in self.notes[:SHOWN_NOTES])]
        if len(self.notes) > SHOWN_NOTES:
            lines.append(f"  and {len(self.notes) - SHOWN_NOTES} more, in the report")
        return lines

    # ------------------------------------------------------------ defaults and assets
    def _defaults(self) -> Element:
        out = Element("default")
        if any(not geom.collides for body in self.robot.bodies for geom in body.geoms):
            out.add("default", class_=VISUAL).add("geom", group=2, contype=0, conaffinity=0, mass=0.0)
        if self.robot.colliders:
            geom = out.add("default", class_=COLLISION).add("geom", group=3, rgba=COLLIDER_COLOR)
            if not self.robot.self_collision:
                geom.attributes.update(contype=0, conaffinity=1)
            if (shared := self._shared_friction()) is not None:
                geom.attributes["friction"] = (shared,)
        for name, members in self.groups.items():
            self._joint_class(out, name, members[0])
        return out

    def _shared_friction(self) -> float | None:
        return next(iter(self._frictions)) if len(self._frictions) == 1 else None

    def _joint_class(self, out: Element, name: str, example: Dof) -> None:
        child = out.add("default", class_=name)
        shared = joint_attributes(example)
        if any(value is not None for value in shared.values()):
            child.add("joint", **shared)
        if example.drive:
            child.add(example.drive.kind, **drive_attributes(example.drive))

    def _assets(self) -> Element:
        out = Element("asset")
        for item in self.robot.materials:
            out.add("material", name=item.name, rgba=item.rgba, metallic=item.metallic, roughness=item.roughness)
        for mesh in self.robot.meshes:
            out.children.append(_mesh(mesh))
        return out

    # ------------------------------------------------------------ bodies
    def _world(self) -> Element:
        out = Element("worldbody")
        for geom in self.robot.static_geoms:
            self._geom(out, geom, static=True)
        self._anchor_sites(out, None)
        for body in self.robot.children(None):
            self._body(out, body)
        return out

    def _body(self, parent: Element, body: Body) -> None:
        out = parent.add("body", name=body.name, **_pose(body.pose))
        out.attributes.update(mocap=True if body.mocap else None, gravcomp=1.0 if body.weightless else None)
        self._inertial(out, body)
        if body.floating:
            out.add("freejoint", name=f"{body.name}_free")
        for dof in body.dofs:
            self._joint(out, dof)
        for site in body.sites:
            out.add("site", name=site.name, **_pose(site.pose))
        self._anchor_sites(out, body.name)
        for geom in body.geoms:
            self._geom(out, geom)
        for child in self.robot.children(body.name):
            self._body(out, child)

    def _inertial(self, out: Element, body: Body) -> None:
        inertial = body.inertial
        out.add(
            "inertial",
            pos=inertial.center_of_mass,
            quat=_turned(inertial.axes),
            mass=inertial.mass,
            diaginertia=inertial.moments,
        )

    def _joint(self, out: Element, dof: Dof) -> None:
        own = {} if dof.name in self._class_of else joint_attributes(dof)
        out.add(
            "joint",
            name=dof.name,
            class_=self._class_of.get(dof.name),
            type=None if dof.kind == "hinge" else dof.kind,
            pos=_moved(dof.anchor),
            axis=None if dof.kind == "ball" else dof.axis,
            range=dof.range,
            ref=dof.ref or None,
            **own,
        )

    def _geom(self, out: Element, geom: Geom, static: bool = False) -> None:
        solid = geom.collides
        friction = None if static is False and geom.friction == self._shared_friction() else geom.friction
        out.add(
            "geom",
            name=geom.name,
            class_=None if static and solid else COLLISION if solid else VISUAL,
            type=geom.kind,
            size=geom.size or None,
            mesh=geom.mesh,
            material=geom.material,
            rgba=geom.rgba,
            friction=None if friction is None else (friction,),
            group=2 if solid and geom.drawn and not static else None,
            **_pose(geom.pose),
        )

    def _anchor_sites(self, out: Element, body: str | None) -> None:
        for closure in self.robot.closures:
            for index, pair in enumerate(closure.anchors):
                for side in (0, 1):
                    if closure.bodies[side] == body:
                        out.add("site", name=f"{closure.name}_{index}_{'ab'[side]}", **_pose(pair[side]))

    # ------------------------------------------------------------ what acts between bodies
    def _contacts(self) -> Element:
        out = Element("contact")
        for first, second in self.robot.exclusions:
            out.add("exclude", body1=first, body2=second)
        return out

    def _equalities(self) -> Element:
        out = Element("equality")
        for closure in self.robot.closures:
            for index in range(len(closure.anchors)):
                stem = f"{closure.name}_{index}"
                name = closure.name if len(closure.anchors) == 1 else stem
                out.add(closure.kind, name=name, site1=f"{stem}_a", site2=f"{stem}_b")
        for item in self.robot.couplings:
            out.add(
                "joint",
                name=item.name,
                joint1=item.joint,
                joint2=item.reference,
                polycoef=item.coefficients,
            )
        return out

    def _actuators(self) -> Element:
        out = Element("actuator")
        for dof in self.robot.dofs:
            if dof.drive is None:
                continue
            own = {} if dof.name in self._class_of else drive_attributes(dof.drive)
            shared = self._class_of.get(dof.name)
            element = out.add(dof.drive.kind, name=dof.name, class_=shared, joint=dof.name, **own)
            if dof.drive.acceleration:
                element.comment = "an acceleration drive: its gains times the inertia that it meets at zero"
        for item in self.robot.actuators:
            out.add(
                "general",
                name=item.name,
                joint=item.joint,
                gear=item.gear if item.gear != (1.0,) else None,
                gainprm=item.gain,
                biastype=item.bias_type if item.bias_type != "none" else None,
                biasprm=item.bias or None,
                ctrlrange=item.control_range,
                forcerange=item.force_range,
                inheritrange=item.inherit_range or None,
            )
        return out

    def _keyframe(self) -> Element:
        out = Element("keyframe")
        positions, velocities = self._state()
        controls = [_control(dof) for dof in self.robot.dofs if dof.drive] + [0.0] * len(self.robot.actuators)
        if positions:
            out.add(
                "key",
                name="home",
                qpos=positions,
                qvel=velocities if any(velocities) else None,
                ctrl=controls if any(controls) else None,
            )
        return out

    def _state(self) -> tuple[list[float], list[float]]:
        """Return qpos and qvel: the saved state, floating bases where they are drawn."""
        positions: list[float] = []
        velocities: list[float] = []
        for body in self.robot.bodies:
            if body.floating:
                positions += [*body.pose.position, *body.pose.rotation]
                velocities += [0.0] * 6
            for dof in body.dofs:
                positions += IDENTITY if dof.kind == "ball" else (dof.position,)
                velocities += [0.0] * 3 if dof.kind == "ball" else [dof.velocity]
        return positions, velocities


def _control(dof: Dof) -> float:
    assert dof.drive is not None
    return {"position": dof.drive.target_position, "velocity": dof.drive.target_velocity, "motor": 0.0}[dof.drive.kind]


def _mesh(mesh: Mesh) -> Element:
    inertia = "convex" if mesh.solid else "shell"
    if not len(mesh.faces):
        return Element("mesh", {"name": mesh.name, "vertex": mesh.vertices.ravel(), "inertia": inertia})
    return Element("mesh", {"name": mesh.name, "file": file_name(mesh), "inertia": inertia})


def _moved(position: Vec3) -> Vec3 | None:
    return position if any(position) else None


def _turned(rotation: Quat) -> Quat | None:
    return None if rotation == IDENTITY else rotation


def _pose(pose: Pose) -> dict[str, Value]:
    return {"pos": _moved(pose.position), "quat": _turned(pose.rotation)}
