"""What the robot's file does not say, or says so that it is lost."""

from __future__ import annotations

import re
from collections.abc import Iterator

import mujoco

from wheelleg_exp.asset.findings import Finding as Record
from wheelleg_exp.asset.findings import Kind
from wheelleg_exp.asset.report import Report
from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.findings import Finding, rule

_ASSET = "env.robot.asset"
_ASSUMED = 0.05  # of the robot's mass that may be assumed without a word
_WEIGHTY = 0.01  # of the robot's mass: a link whose tensor matters
_LOST = re.compile(r"collider was left out|wrong way round|coupling was left out|drive is lost")
_LOST_MESH = re.compile(r"collider was left out: mesh '([^']*)': (.*)")
_MOST = 4
_HINGE = mujoco.mjtJoint.mjJNT_HINGE


def records(case: Case, kind: Kind) -> list[Record]:
    """Return what the conversion found of a kind; nothing where there was none."""
    report = case.robot.report if case.robot is not None else None
    return [item for item in report.findings if item.kind == kind] if report is not None else []


def missing_colliders(report: Report, model: mujoco.MjModel) -> str:
    """Return which colliders a robot lacks because files are missing or damaged, and whose wheels they may be.

    Args:
        report: of the conversion.
        model: the compiled robot.

    Returns:
        The message, the same for every command; empty if no collider is known to be missing.
    """
    files = {match[1]: match[2] for text in report.warnings if (match := _LOST_MESH.search(text))}
    bare = [item.subject for item in report.findings if item.kind == "end_without_collider"]
    if any(item.kind == "no_colliders" for item in report.findings):
        ends = zip(model.jnt_bodyid, model.jnt_dofadr, strict=True)
        bare = [model.body(int(body)).name for body, dof in ends if dof not in model.dof_parentid]
    layers = [item for item in report.findings if item.kind == "layer_not_found" and not item.numbers["looks"]]
    files |= {item.subject: "the layer is not there" for item in layers if bare}
    if not files:
        return ""
    hinges = [int(model.body(name).jntadr[0]) for name in bare if model.body(name).jntnum[0] == 1]
    wheels = [repr(model.joint(j).name) for j in hinges if model.jnt_type[j] == _HINGE and not model.jnt_limited[j]]
    told = [f"{name} ({reason})" for name, reason in files.items()]
    text = "colliders are missing: " + ", ".join(told[:_MOST]) + (", ..." if len(told) > _MOST else "")
    return text + (f"; {', '.join(wheels)} turn without limits, as wheels do, and lack a collider" if wheels else "")


@rule
def missing_files(case: Case) -> Iterator[Finding]:
    """Meshes of colliders, or layers, that the robot's file names and that cannot be read.

    Files are missing, or damaged, or pointers of Git LFS. A wheel without its collider is treated as the joint of a
    leg. Files of visuals are left out. Source: the conversion report.
    """
    report = case.robot.report if case.robot is not None else None
    if case.robot is None or report is None:
        return
    message = missing_colliders(report, case.robot.model)
    layers = [item.subject for item in records(case, "layer_not_found") if not item.numbers["looks"]]
    if message or layers:
        message = message or f"layers that the robot names are not there: {', '.join(layers[:_MOST])}"
        yield Finding(_ASSET, message, "put the files where the names lead (git lfs pull), or correct the names")


@rule
def no_colliders(case: Case) -> Iterator[Finding]:
    """A robot without a shape that touches anything.

    It falls through the ground. Source: the compiled model.
    """
    robot = case.robot
    if robot is None:
        return
    bodies = {robot.model.body(name).id for name in robot.bodies}
    solid = (robot.model.geom_contype != 0) | (robot.model.geom_conaffinity != 0)
    if not any(int(body) in bodies for body in robot.model.geom_bodyid[solid]):
        yield Finding(
            _ASSET,
            "no shape of the robot collides: it falls through the ground",
            "colliders: a cylinder on each wheel and a box on the body are enough to begin with",
        )


@rule
def assumed_masses(case: Case) -> Iterator[Finding]:
    """Masses and inertias that the file does not give, so that the converter assumed them.

    They follow from volumes and a density, or are 1 kg: the dynamics are then guessed. Source: the conversion report.
    """
    total = case.facts.mass
    links = [item for item in records(case, "no_inertial") if item.numbers["mass"] > 0]
    assumed = sum(item.numbers["mass"] for item in links)
    if assumed > _ASSUMED * total:
        yield Finding(
            _ASSET,
            f"{assumed:.3g} of {total:.4g} kg are assumed ({100 * assumed / total:.0f} %): {len(links)} "
            f"{'link has' if len(links) == 1 else 'links have'} no mass, such as '{links[0].subject}'",
            "mass and inertia of these links in the file",
            {"assumed_kg": assumed, "mass_kg": total},
        )
    guessed = [item.subject for item in records(case, "no_inertia") if item.numbers["mass"] > _WEIGHTY * total]
    if guessed:
        yield Finding(
            _ASSET,
            f"{len(guessed)} {'link has' if len(guessed) == 1 else 'links have'} a mass and no inertia, such as "
            f"'{guessed[0]}': the tensor is assumed",
            "inertia of these links in the file",
            {"links": float(len(guessed))},
        )


@rule
def lost_in_conversion(case: Case) -> Iterator[Finding]:
    """Colliders, limits, couplings and drives of the file that the model does not have, or has otherwise.

    Source: the warnings of the conversion report.
    """
    report = case.robot.report if case.robot is not None else None
    lost = [text for text in report.warnings if _LOST.search(text) and not _LOST_MESH.search(text)] if report else []
    if lost:
        shown = "; ".join(lost[:_MOST]) + (f"; and {len(lost) - _MOST} more" if len(lost) > _MOST else "")
        yield Finding(_ASSET, shown, "correct the file: `wheelleg convert` tells all of it", {"lost": float(len(lost))})
