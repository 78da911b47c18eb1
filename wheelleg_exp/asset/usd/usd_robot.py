"""Read a USD file into a robot description and a conversion report.

Numbers that the USD file stores in single precision become their shortest decimals; double-precision numbers stay
exact. USD's schemas define joint frames, limits, drives, and most masses in single precision. Transforms may be either:
they are treated as single if none of them changes in single precision, as in files whose writer widened them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Usd

from wheelleg_exp.asset import robot_description as desc
from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.asset.report_writer import report_of
from wheelleg_exp.asset.rigid_geometry import single
from wheelleg_exp.asset.usd.audit import audit
from wheelleg_exp.asset.usd.bodies.body_tree import Graph, build_tree, read_closures
from wheelleg_exp.asset.usd.bodies.mass import inertial_of
from wheelleg_exp.asset.usd.bodies.rigid_bodies import find_links, velocity_of
from wheelleg_exp.asset.usd.colliders import find_pieces, find_sites
from wheelleg_exp.asset.usd.joints.articulate import dofs_of
from wheelleg_exp.asset.usd.joints.joint_couplings import read_mimics, read_ropes
from wheelleg_exp.asset.usd.joints.usd_joints import DISTANCE, read_joints
from wheelleg_exp.asset.usd.mjc_overlay import distinct, with_mujoco
from wheelleg_exp.asset.usd.usd_geoms import Geoms, quiet_parts, read_filters
from wheelleg_exp.asset.usd.usd_stage import Stage, gravity, library, open_stage

HALF_STEP = 2.0**-25
MOST_DIGITS = 9


def shortened(stage: Stage, robot: desc.RobotDescription) -> desc.RobotDescription:
    """Return the robot with each single-precision number replaced by its shortest decimal, such as 0.0425."""
    coarse = all(_is_single(prim) for prim in stage.prims)
    bodies = []
    for body in robot.bodies:
        # Do not round the moments of inertia, because the three moments must satisfy the triangle inequality.
        inertial, (w, x, y, z) = body.inertial, _shortest(body.inertial.axes, 1.0)
        center = _short_vector(inertial.center_of_mass)
        changed = replace(
            body,
            pose=_short_pose(body.pose) if body.parent is not None or coarse else body.pose,
            inertial=replace(inertial, center_of_mass=center, axes=(w, x, y, z)),
            dofs=tuple(_short_dof(stage, dof) for dof in body.dofs),
            geoms=tuple(map(_short_geom, body.geoms)) if coarse else body.geoms,
        )
        bodies.append(changed)
    static = tuple(_short_geom(geom) for geom in robot.static_geoms) if coarse else robot.static_geoms
    return replace(robot, bodies=tuple(bodies), static_geoms=static)


def _is_single(prim: Usd.Prim) -> bool:
    for name in prim.GetAuthoredPropertyNames():
        if name.startswith("xformOp:"):
            value = prim.GetAttribute(name).Get() if prim.GetAttribute(name) else None
            if value is not None and hasattr(value, "GetImaginary"):
                value = (value.GetReal(), *value.GetImaginary())
            numbers = np.asarray(0.0 if value is None else value, dtype=float)
            if not np.array_equal(numbers, numbers.astype(np.float32)):
                return False
    return True


def _short_dof(stage: Stage, dof: desc.Dof) -> desc.Dof:
    """Round the numbers of a joint, unless it has attributes of MuJoCo's schemas, which have double precision."""
    if any(name.startswith("mjc:") for name in stage.ledger.authored.get(dof.path, {})):
        return dof
    drive = dof.drive and replace(
        dof.drive,
        stiffness=single(dof.drive.stiffness),
        damping=single(dof.drive.damping),
        effort=dof.drive.effort and single(dof.drive.effort),
        target_position=single(dof.drive.target_position),
        target_velocity=single(dof.drive.target_velocity),
    )
    return replace(
        dof,
        position=single(dof.position),
        velocity=single(dof.velocity),
        max_velocity=dof.max_velocity and single(dof.max_velocity),
        axis=_short_vector(dof.axis),
        anchor=_short_vector(dof.anchor),
        range=None if dof.range is None else (single(dof.range[0]), single(dof.range[1])),
        drive=drive,
    )


def _short_geom(geom: desc.Geom) -> desc.Geom:
    return replace(geom, size=tuple(single(value) for value in geom.size), pose=_short_pose(geom.pose))


def _short_pose(pose: desc.Pose) -> desc.Pose:
    w, x, y, z = _shortest(pose.rotation, 1.0)
    return desc.Pose(_short_vector(pose.position), (w, x, y, z))


def _short_vector(values: desc.Vec3) -> desc.Vec3:
    x, y, z = _shortest(values, max(map(abs, values)))
    return x, y, z


def _shortest(values: Iterable[float], size: float) -> list[float]:
    found = []
    for value in values:
        decimals = (float(f"{value:.{digits}g}") + 0.0 for digits in range(1, MOST_DIGITS + 1))
        found.append(next((short for short in decimals if abs(short - value) <= size * HALF_STEP), value))
    return found


def read_usd(source: Path, base: desc.BaseMode, variants: Mapping[str, str]) -> tuple[desc.RobotDescription, Report]:
    """Read the robot of a USD file, and make the conversion report."""
    with library(source):
        stage = open_stage(source, variants)
        robot, units = describe(stage, base), stage.units
        report = report_of(
            robot,
            stage.ledger,
            source=source.name,
            root=str(stage.root.GetPath()),
            stage={"metersPerUnit": units.meters, "kilogramsPerUnit": units.kilograms, "upAxis": str(units.up)},
            variants=stage.variants,
            unresolved=stage.unresolved,
            layers=stage.layers,
        )
        return robot, report


def describe(stage: Stage, base: desc.BaseMode) -> desc.RobotDescription:
    """Return the robot description of an open USD stage."""
    links = find_links(stage)
    joints = list(read_joints(stage, links))
    tree = build_tree(stage, links, [joint for joint in joints if joint.kind != DISTANCE], base)
    ropes, pieces = read_ropes(stage, joints), find_pieces(stage, links)
    # If the robot's colliders can never touch each other, one MJCF default class disables self-collision.
    quiet = quiet_parts(stage, Graph(links, joints))
    solid = {piece.link.path for piece in pieces if piece.link and piece.collides}
    touching = len(quiet) != 1 or not solid <= quiet[0]
    exclusions, bits = read_filters(stage, links, joints, pieces, quiet if touching else None)
    shapes, sites = Geoms(stage, pieces, bits), find_sites(stage, links)
    dofs = {node.link.path: dofs_of(stage, node, bool(tree.closures)) for node in tree.nodes}
    bodies = []
    for node in desc.depth_first(
        tree.nodes, lambda node: node.link.path, lambda node: node.parent.path if node.parent else None
    ):
        link, own = node.link, dofs[node.link.path]
        pieces_of_body = shapes.pieces.get(link.path, [])
        body = desc.Body(
            name=link.name,
            path=link.path,
            parent=node.parent.name if node.parent else None,
            pose=node.pose,
            inertial=inertial_of(stage, link, pieces_of_body, welded=node.joint is not None and not own),
            floating=node.floating,
            velocity=velocity_of(stage, link) if node.floating else (0.0,) * 6,
            mocap=link.kinematic and node.parent is None and not own,
            weightless=link.weightless,
            dofs=own,
            geoms=shapes.of(link),
            sites=(*sites.get(link.path, ()), *ropes.sites.get(link.name, ())),
        )
        bodies.append(body)
    levels = sorted(tree.nodes, key=lambda node: node.depth)
    robot = desc.RobotDescription(
        name=stage.source.stem if stage.root.IsPseudoRoot() else stage.root.GetName(),
        bodies=tuple(bodies),
        gravity=gravity(stage),
        static_geoms=shapes.of(None),
        static_sites=tuple(ropes.sites.get(None, ())),
        exclusions=exclusions,
        closures=(*read_closures(stage, tree.closures), *ropes.closures),
        couplings=tuple(read_mimics(stage, [dof for body in bodies for dof in body.dofs])),
        tendons=tuple(ropes.tendons),
        materials=tuple(shapes.materials.values()),
        meshes=tuple(shapes.meshes.values()),
        self_collision=touching,
        breadth_first_dofs=tuple(
            dof.name for node in levels for dof in dofs[node.link.path][:: -1 if node.reversed else 1]
        ),
    )
    robot = replace(robot, static_sites=(*robot.static_sites, *distinct(robot.sites, sites.get(None, ()))))
    robot = with_mujoco(stage, links, robot)
    if "integrator" not in robot.option and any(dof.drive and dof.drive.kind != "motor" for dof in robot.dofs):
        # MuJoCo's default integrator (Euler) is unstable with stiff drives.
        stage.ledger.assume(stage.source.name, "drives are integrated implicitly, as in PhysX", "implicitfast")
        robot = replace(robot, option={**robot.option, "integrator": "implicitfast"})
    robot = shortened(stage, robot)
    audit(stage)
    return robot
