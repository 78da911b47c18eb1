"""What the robot's file does not say, or says so that it is lost."""

from __future__ import annotations

import re
from collections.abc import Iterator

from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.findings import Finding, rule

_ASSET = "env.robot.asset"
_ASSUMED = 0.05  # of the robot's mass that may be assumed without a word
_MASS = re.compile(r"no mass\b.*")
_LOST = re.compile(r"collider was left out|wrong way round|coupling was left out|drive is lost")
_NO_FILE = "the file is not there"
_MOST = 4


@rule
def missing_files(case: Case) -> Iterator[Finding]:
    """Meshes of colliders, or layers, that the robot's file names and that are not there.

    What they would have given is missing in the model. Files that are only drawn are left out. Source: the conversion
    report.
    """
    report = case.robot.report if case.robot is not None else None
    if report is None:
        return
    lost = [text for text in report.warnings if "collider was left out" in text and _NO_FILE in text]
    layers = [name for name in report.unresolved if ".usd" in name.lower()]
    if not lost and not layers:
        return  # what was to be drawn only
    missing = report.unresolved
    gone = f", so that {len(lost)} {'collider is' if len(lost) == 1 else 'colliders are'} lost" if lost else ""
    yield Finding(
        _ASSET,
        f"{len(missing)} {'file' if len(missing) == 1 else 'files'} that the robot names {_are(missing)} not there"
        f"{gone}: {', '.join(missing[:2])}{', ...' if len(missing) > 2 else ''}",
        "put them where the names lead, or correct the names",
        {"files": float(len(missing)), "colliders": float(len(lost))},
    )


@rule
def no_colliders(case: Case) -> Iterator[Finding]:
    """A robot, or a wheel's link, without a shape that touches anything.

    It would fall through the ground. Source: the compiled model.
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
    """Masses that the file does not give, so that the converter assumed them.

    They follow from volumes and a density, or are 1 kg: the dynamics are then guessed. Source: the conversion report.
    """
    robot = case.robot
    if robot is None or robot.report is None:
        return
    total = case.facts.mass
    assumed = 0.0
    links = []
    for item in robot.report.assumptions:
        value = re.match(r"([0-9.eE+-]+) kg", item.value)
        if _MASS.match(item.rule) and value is not None and float(value[1]) > 0:
            assumed += float(value[1])
            links.append(item.path)
    if links and total > 0 and assumed > _ASSUMED * total:
        yield Finding(
            _ASSET,
            f"{assumed:.3g} of {total:.4g} kg are assumed ({min(100.0, 100 * assumed / total):.0f} %): "
            f"{len(links)} links have no mass, such as {links[0]}",
            "mass and inertia of these links in the file",
            {"assumed_kg": assumed, "mass_kg": total},
        )
    guessed = [item.path for item in robot.report.assumptions if item.rule.startswith("no inertia")]
    names = [path for path in guessed if _weighty(case, path)]
    if names and not links:
        yield Finding(
            _ASSET,
            f"{len(names)} links have a mass and no inertia, such as {names[0]}: the tensor is assumed",
            "inertia of these links in the file",
            {"links": float(len(names))},
        )


def _weighty(case: Case, path: str) -> bool:
    """Return whether a path of the report is that of a link that weighs a hundredth of the robot."""
    robot = case.robot
    assert robot is not None
    name = re.search(r"\[(.+)\]$", path)
    wanted = name[1] if name else path.rsplit("/", 1)[-1]
    masses = {body: float(robot.model.body(body).mass[0]) for body in robot.bodies}
    return masses.get(wanted, 0.0) > 0.01 * case.facts.mass


@rule
def lost_in_conversion(case: Case) -> Iterator[Finding]:
    """Colliders, limits, couplings and drives of the file that the model does not have, or has otherwise.

    Source: the warnings of the conversion report.
    """
    robot = case.robot
    if robot is None or robot.report is None:
        return
    lost = [text for text in robot.report.warnings if _LOST.search(text) and _NO_FILE not in text]
    if lost:
        shown = "; ".join(lost[:_MOST]) + (f"; and {len(lost) - _MOST} more" if len(lost) > _MOST else "")
        yield Finding(_ASSET, shown, "correct the file: `wheelleg convert` tells all of it", {"lost": float(len(lost))})


def _are(items: tuple[str, ...]) -> str:
    return "is" if len(items) == 1 else "are"
