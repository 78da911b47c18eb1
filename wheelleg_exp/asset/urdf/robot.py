"""Puts the readers together: a URDF becomes a robot description and a report."""

from __future__ import annotations

from pathlib import Path

from wheelleg_exp.asset.description import BaseMode, Body, Dof, Inertial, Pose, RobotDescription
from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.naming import RESERVED
from wheelleg_exp.asset.report import Report
from wheelleg_exp.asset.urdf.audit import audit
from wheelleg_exp.asset.urdf.document import Document, open_document
from wheelleg_exp.asset.urdf.files import Files
from wheelleg_exp.asset.urdf.inertia import inertials
from wheelleg_exp.asset.urdf.joints import couplings, dofs_of
from wheelleg_exp.asset.urdf.kinematics import Link, Tree, read_tree
from wheelleg_exp.asset.urdf.mujoco_reader import Seen, read_with_mujoco
from wheelleg_exp.asset.urdf.shapes import Shapes
from wheelleg_exp.asset.usd.summary import report_of

SUFFIXES = (".urdf",)
EARTH = 9.81
SI = {"metersPerUnit": 1.0, "kilogramsPerUnit": 1.0, "upAxis": "Z"}  # URDF has no others


def read_urdf(source: Path, base: BaseMode) -> tuple[RobotDescription, Report]:
    """Read a robot and say what was read, assumed and left out.

    Raises:
        AssetError: the file cannot be read, or is no robot.
    """
    document = open_document(source)
    robot, files = describe(document, base)
    return robot, summarise(document, robot, files)


def source_files(source: Path) -> dict[str, str]:
    """Return the sha256 of a URDF and of each mesh file that it names, by path as seen from its folder.

    Raises:
        AssetError: the file cannot be read.
    """
    document = open_document(source)
    files = Files(document)
    for element in document.root.walk():
        if element.tag == "mesh" and (name := element.attributes.get("filename")):
            files.find(name)
    return dict(sorted(files.hashes.items()))


def describe(document: Document, base: BaseMode) -> tuple[RobotDescription, Files]:
    """Return the robot of a document, and the files that it is made of."""
    return _Builder(document, base).build()


class _Builder:
    """Makes bodies of links; the world, if the file has it, is none."""

    def __init__(self, document: Document, base: BaseMode) -> None:
        self.document, self.base = document, base
        self.tree: Tree = read_tree(document)
        self.seen: dict[str, Seen] = read_with_mujoco(document, self.tree)
        self.files = Files(document)
        self.shapes = Shapes(document, self.tree, self.seen, self.files)
        self.names = _body_names(document, self.tree)
        joints = self.tree.joints.values()
        self.dofs = {joint.name: dofs_of(document, joint, self.seen[joint.child.name]) for joint in joints}

    def build(self) -> tuple[RobotDescription, Files]:
        """Return the robot, and the files that it names."""
        tree, document = self.tree, self.document
        masses = inertials(document, tree, self.seen, self.shapes.solids(), self.base)
        links = [link for link in tree.depth_first() if link is not tree.world]
        if not links:
            document.fail(tree.root.element, "the file holds the world and nothing in it", "a robot")
        bodies = _floating_last([self._body(link, masses[link.name]) for link in links])
        robot = RobotDescription(
            name=document.root.attributes.get("name") or document.source.stem,
            bodies=bodies,
            gravity=(0.0, 0.0, -EARTH),
            static_geoms=self.shapes.geoms(tree.world) if tree.world else (),
            exclusions=self._exclusions(),
            couplings=couplings(document, tree, self._single_dofs()),
            materials=tuple(self.shapes.looks.used.values()),
            meshes=self.shapes.meshes(),
            breadth_first_dofs=self._breadth_first(),
        )
        document.ledger.assume(document.source.name, "a URDF has no gravity", f"{EARTH} m/s² downwards")
        audit(document)
        for name in self.files.missing:
            document.ledger.warn(f"not found, read without it: {name}")
            document.ledger.find("mesh_not_found", name, document.source.name, **self._named_by(name))
        return robot, self.files

    def _named_by(self, file: str) -> dict[str, float]:
        """Return how many colliders and visuals name a file."""
        shapes = [placed for seen in self.seen.values() for placed in seen.shapes]
        of_file = [
            placed.collides
            for placed in shapes
            if any(e.attributes.get("filename") == file for e in placed.element.walk())
        ]
        return {"colliders": sum(of_file), "visuals": len(of_file) - sum(of_file)}

    # ------------------------------------------------------------ bodies
    def _body(self, link: Link, inertial: Inertial) -> Body:
        joint, path = link.joint, link.element.path
        self.document.ledger.mapped(path, "link", f"body {self.names[link.name]}")
        floating = self._floats(link)
        inside = joint is not None and joint.parent is not self.tree.world and not floating
        return Body(
            name=self.names[link.name],
            path=path,
            parent=self.names[joint.parent.name] if joint and inside else None,
            pose=self._world_pose(link) if floating else self.seen[link.name].pose,
            inertial=inertial,
            floating=floating,
            dofs=self.dofs[joint.name] if joint else (),
            geoms=self.shapes.geoms(link),
        )

    def _floats(self, link: Link) -> bool:
        """Return whether a link moves freely: by a floating joint, or as the root of a robot that is not fixed."""
        joint, ledger = link.joint, self.document.ledger
        if joint is None:
            if self.base == "auto":
                rule = "a URDF does not say how its base stands: as in Gazebo and PyBullet; --base fixed pins it"
                ledger.assume(link.element.path, rule, "floating")
            elif self.base == "fixed":
                ledger.assume(link.element.path, "--base fixed", "no free joint")
            return self.base != "fixed"
        to_world = joint.parent is self.tree.world
        if to_world and joint.welds and self.base == "floating":
            ledger.leave(joint.element.path, "joint", "--base floating drops the joint to the world")
            return True
        if to_world and joint.kind == "floating" and self.base == "fixed":
            ledger.leave(joint.element.path, "joint", "--base fixed removes the free joint")
            return False
        return joint.kind == "floating"

    def _world_pose(self, link: Link) -> Pose:
        """Return where a link stands when all coordinates are zero."""
        chain = [link]
        while chain[-1].joint is not None:
            chain.append(chain[-1].joint.parent)
        if len(chain) == 1:
            return self.seen[link.name].pose
        frame = Frame.identity()
        for item in reversed(chain):
            frame = frame @ Frame.of(self.seen[item.name].pose)
        return frame.pose()

    # ------------------------------------------------------------ joints
    def _single_dofs(self) -> dict[str, Dof]:
        return {name: dofs[0] for name, dofs in self.dofs.items() if len(dofs) == 1 and dofs[0].kind != "ball"}

    def _breadth_first(self) -> tuple[str, ...]:
        joints = [link.joint for link in self.tree.breadth_first() if link.joint is not None]
        return tuple(dof.name for joint in joints for dof in self.dofs[joint.name])

    def _exclusions(self) -> tuple[tuple[str, str], ...]:
        """Return the pairs that never touch: links that a joint holds together."""
        pairs = []
        for joint in self.tree.joints.values():
            if joint.parent is not self.tree.world and joint.kind != "floating":
                pairs.append((self.names[joint.parent.name], self.names[joint.child.name]))
        return tuple(pairs)


def _floating_last(bodies: list[Body]) -> tuple[Body, ...]:
    """Return the bodies so that each tree stands whole: a link on a floating joint starts a tree of its own."""
    children: dict[str | None, list[Body]] = {}
    for body in bodies:
        children.setdefault(body.parent, []).append(body)
    out: list[Body] = []
    stack = list(reversed(children.get(None, [])))
    while stack:
        body = stack.pop()
        out.append(body)
        stack.extend(reversed(children.get(body.name, [])))
    return tuple(out)


def _body_names(document: Document, tree: Tree) -> dict[str, str]:
    """Return the bodies' names: the links', but for one that MuJoCo keeps for itself."""
    names = {name: name for name in tree.links}
    for name in RESERVED & set(names):
        if tree.world is not None and tree.world.name == name:
            continue
        free = f"{name}_link"
        while free in names:
            free += "_"
        names[name] = free
        document.ledger.assume(tree.links[name].element.path, f"MuJoCo keeps the name '{name}'", free)
    return names


def summarise(document: Document, robot: RobotDescription, files: Files) -> Report:
    """Return the report of a URDF and the robot read from it."""
    return report_of(
        robot,
        document.ledger,
        source=document.source.name,
        root=document.root.path,
        stage=dict(SI),
        variants={},
        unresolved=tuple(files.missing),
        layers=dict(sorted(files.hashes.items())),
    )
