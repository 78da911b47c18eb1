"""Puts the readers together: a USD file becomes a robot description and a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from wheelleg_exp.asset.description import BaseMode, Body, Closure, Dof, Pose, RobotDescription, Site
from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.reader.articulate import dofs_of
from wheelleg_exp.asset.reader.audit import audit
from wheelleg_exp.asset.reader.bodies import find_links
from wheelleg_exp.asset.reader.colliders import find_pieces
from wheelleg_exp.asset.reader.geoms import Geoms
from wheelleg_exp.asset.reader.joints import Joint, read_joints
from wheelleg_exp.asset.reader.mass import inertial_of
from wheelleg_exp.asset.reader.mujoco import actuators, couplings
from wheelleg_exp.asset.reader.scene import exclusions, gravity, self_collision
from wheelleg_exp.asset.reader.sites import find_sites
from wheelleg_exp.asset.reader.stage import Stage, open_stage
from wheelleg_exp.asset.reader.summary import summarise
from wheelleg_exp.asset.reader.tree import Node, Tree, build_tree
from wheelleg_exp.asset.report import Report


def read_usd(source: Path, base: BaseMode, variants: Mapping[str, str]) -> tuple[RobotDescription, Report]:
    """Read a robot and say what was read, assumed and left out.

    Raises:
        AssetError: the file cannot be read, or holds no rigid body.
    """
    stage = open_stage(source, variants)
    robot = describe(stage, base)
    return robot, summarise(stage, robot)


def describe(stage: Stage, base: BaseMode) -> RobotDescription:
    """Return the robot of an open stage."""
    links = find_links(stage)
    joints = read_joints(stage, links)
    tree = build_tree(stage, links, joints, base)
    geoms = Geoms(stage, find_pieces(stage, links))
    bodies, order = _bodies(stage, tree, geoms, find_sites(stage, links))
    coordinates = {dof.path: dof.name for body in bodies for dof in body.dofs}
    robot = RobotDescription(
        name=stage.root.GetName() or stage.source.stem,
        bodies=bodies,
        gravity=gravity(stage),
        static_geoms=geoms.of(None),
        exclusions=tuple(exclusions(stage, links, joints)),
        closures=_closures(stage, tree.closures),
        couplings=couplings(stage, coordinates),
        actuators=actuators(stage, coordinates),
        materials=tuple(geoms.materials()),
        meshes=tuple(geoms.meshes()),
        self_collision=self_collision(stage),
        breadth_first_dofs=order,
    )
    audit(stage)
    return robot


def _bodies(
    stage: Stage, tree: Tree, geoms: Geoms, sites: dict[str, list[Site]]
) -> tuple[tuple[Body, ...], tuple[str, ...]]:
    """Return the bodies depth first, and the names of their degrees of freedom breadth first."""
    dofs = {node.link.path: dofs_of(stage, node) for node in tree.nodes}
    bodies = tuple(
        _body(stage, node, dofs[node.link.path], geoms, sites.get(node.link.path, [])) for node in tree.depth_first()
    )
    levels = sorted(tree.nodes, key=lambda node: node.depth)
    return bodies, tuple(dof.name for node in levels for dof in dofs[node.link.path])


def _body(stage: Stage, node: Node, dofs: tuple[Dof, ...], geoms: Geoms, sites: list[Site]) -> Body:
    link = node.link
    return Body(
        name=link.name,
        path=link.path,
        parent=node.parent.name if node.parent else None,
        pose=node.pose,
        inertial=inertial_of(stage, link, geoms.pieces_of(link)),
        floating=node.floating,
        mocap=link.kinematic and node.parent is None and not dofs,
        weightless=link.weightless,
        dofs=dofs,
        geoms=geoms.of(link),
        sites=tuple(sites),
    )


HINGE_REACH = 0.05  # m between the two points that keep a loop's hinge on its axis


def _closures(stage: Stage, joints: list[Joint]) -> tuple[Closure, ...]:
    found = (_closure(stage, joint) for joint in joints)
    return tuple(closure for closure in found if closure is not None)


def _closure(stage: Stage, joint: Joint) -> Closure | None:
    kind = str(joint.prim.GetTypeName())
    if any(axis.kind == "slide" for axis in joint.axes):
        stage.ledger.leave(joint.path, kind, "a sliding joint that closes a loop")
        stage.ledger.warn(f"{joint.path}: a sliding joint closes a loop and was left out")
        return None
    if len(joint.axes) > 1:
        stage.ledger.warn(f"{joint.path}: closes a loop with {len(joint.axes)} axes; only its point is kept")
    equality: Literal["weld", "connect"] = "weld" if joint.welds else "connect"
    stage.ledger.mapped(joint.path, kind, f"equality {equality}")
    first, second = (link.name if link else None for link in joint.links)
    return Closure(joint.name, joint.path, equality, (first, second), tuple(_anchors(joint)))


def _anchors(joint: Joint) -> Iterator[tuple[Pose, Pose]]:
    """Yield pairs of points that a loop's joint holds together: for a hinge a second one along its axis."""
    first, second = joint.frames
    yield first.pose(), second.pose()
    if len(joint.axes) == 1 and joint.axes[0].kind == "hinge":
        along = Frame(np.eye(3), HINGE_REACH * np.array(joint.axes[0].axis))
        yield (first @ along).pose(), (second @ along).pose()
