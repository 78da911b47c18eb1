"""Puts the readers together: a USD file becomes a robot description and a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from wheelleg_exp.asset.description import BaseMode, Body, Dof, Geom, RobotDescription, Site
from wheelleg_exp.asset.report import Report
from wheelleg_exp.asset.usd.audit import audit
from wheelleg_exp.asset.usd.bodies.loops import read_closures
from wheelleg_exp.asset.usd.bodies.mass import inertial_of
from wheelleg_exp.asset.usd.bodies.nodes import Node, Tree
from wheelleg_exp.asset.usd.bodies.rigid_bodies import find_links
from wheelleg_exp.asset.usd.bodies.roots import Graph
from wheelleg_exp.asset.usd.bodies.tree import build_tree
from wheelleg_exp.asset.usd.bodies.velocity import velocity_of
from wheelleg_exp.asset.usd.joints.articulate import dofs_of
from wheelleg_exp.asset.usd.joints.distance import Ropes, read_ropes
from wheelleg_exp.asset.usd.joints.joints import DISTANCE, read_joints
from wheelleg_exp.asset.usd.joints.mimic import read_mimics
from wheelleg_exp.asset.usd.mjc import with_mujoco
from wheelleg_exp.asset.usd.precision import shortened
from wheelleg_exp.asset.usd.scene import gravity
from wheelleg_exp.asset.usd.shapes.colliders import find_pieces
from wheelleg_exp.asset.usd.shapes.collision_filters import Filters, all_quiet, quiet_parts, read_filters
from wheelleg_exp.asset.usd.shapes.geoms import Geoms
from wheelleg_exp.asset.usd.shapes.sites import find_sites
from wheelleg_exp.asset.usd.stage import Stage, library, open_stage
from wheelleg_exp.asset.usd.summary import summarise


def read_usd(source: Path, base: BaseMode, variants: Mapping[str, str]) -> tuple[RobotDescription, Report]:
    """Read a robot and say what was read, assumed and left out.

    Raises:
        AssetError: the file cannot be read, or holds no rigid body.
    """
    with library(source):
        stage = open_stage(source, variants)
        robot = describe(stage, base)
        return robot, summarise(stage, robot)


def describe(stage: Stage, base: BaseMode) -> RobotDescription:
    """Return the robot of an open stage."""
    links = find_links(stage)
    joints = read_joints(stage, links)
    tree = build_tree(stage, links, [joint for joint in joints if joint.kind != DISTANCE], base)
    ropes, pieces = read_ropes(stage, joints), find_pieces(stage, links)
    quiet = quiet_parts(stage, Graph(links, joints))
    touching = not all_quiet(quiet, {piece.link.path for piece in pieces if piece.link and piece.collides})
    filters = read_filters(stage, links, joints, pieces, quiet if touching else None)
    parts = _Parts(stage, Geoms(stage, pieces), filters, ropes)
    parts.sites = find_sites(stage, links)
    dofs = {node.link.path: dofs_of(stage, node, bool(tree.closures)) for node in tree.nodes}
    bodies = tuple(parts.body(node, dofs[node.link.path]) for node in tree.depth_first())
    robot = RobotDescription(
        name=stage.source.stem if stage.root.IsPseudoRoot() else stage.root.GetName(),
        bodies=bodies,
        gravity=gravity(stage),
        static_geoms=parts.geoms(None),
        static_sites=tuple(ropes.sites.get(None, ())),
        exclusions=parts.filters.pairs,
        closures=(*read_closures(stage, tree.closures), *ropes.closures),
        couplings=read_mimics(stage, [dof for body in bodies for dof in body.dofs]),
        tendons=tuple(ropes.tendons),
        materials=tuple(parts.shapes.materials()),
        meshes=tuple(parts.shapes.meshes()),
        self_collision=touching,
        breadth_first_dofs=_breadth_first(tree, dofs),
    )
    robot = shortened(stage, _integrated(stage, with_mujoco(stage, links, robot)))
    audit(stage)
    return robot


def _integrated(stage: Stage, robot: RobotDescription) -> RobotDescription:
    """Let stiff drives be integrated as PhysX does, implicitly; MuJoCo's own default blows some of them up."""
    if "integrator" in robot.option or not any(dof.drive and dof.drive.kind != "motor" for dof in robot.dofs):
        return robot
    stage.ledger.assume(stage.source.name, "drives are integrated implicitly, as in PhysX", "implicitfast")
    return replace(robot, option={**robot.option, "integrator": "implicitfast"})


def _breadth_first(tree: Tree, dofs: Mapping[str, tuple[Dof, ...]]) -> tuple[str, ...]:
    levels = sorted(tree.nodes, key=lambda node: node.depth)
    return tuple(dof.name for node in levels for dof in dofs[node.link.path][:: -1 if node.reversed else 1])


class _Parts:
    """What bodies are made of, by body."""

    def __init__(self, stage: Stage, shapes: Geoms, filters: Filters, ropes: Ropes) -> None:
        self.stage, self.shapes, self.filters, self.ropes = stage, shapes, filters, ropes
        self.sites: dict[str, list[Site]] = {}

    def geoms(self, node: Node | None) -> tuple[Geom, ...]:
        """Return the shapes of a body (None: the world) with their bits."""
        bits = self.filters.bits
        found = self.shapes.of(node.link if node else None)
        return tuple(replace(geom, extra={**geom.extra, **bits.get(geom.path, {})}) for geom in found)

    def body(self, node: Node, dofs: tuple[Dof, ...]) -> Body:
        """Return a body with everything on it."""
        link = node.link
        return Body(
            name=link.name,
            path=link.path,
            parent=node.parent.name if node.parent else None,
            pose=node.pose,
            inertial=inertial_of(
                self.stage, link, self.shapes.pieces_of(link), welded=node.joint is not None and not dofs
            ),
            floating=node.floating,
            velocity=velocity_of(self.stage, link) if node.floating else (0.0,) * 6,
            mocap=link.kinematic and node.parent is None and not dofs,
            weightless=link.weightless,
            dofs=dofs,
            geoms=self.geoms(node),
            sites=(*self.sites.get(link.path, ()), *self.ropes.sites.get(link.name, ())),
        )
