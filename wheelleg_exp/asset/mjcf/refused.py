"""Leaves out what MuJoCo refuses of a file's own MuJoCo attributes: that one, and not the robot.

USD's MuJoCo schemas let a file say what MuJoCo does not take, such as an ``actdim`` without a ``dyntype``. Which one it
is, is found by trying: without it MuJoCo's complaint is another one, or gone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

from wheelleg_exp.asset.description import RobotDescription
from wheelleg_exp.asset.mjcf.document import Writer, file_name, obj_text
from wheelleg_exp.asset.mjcf.verify import ModelRefused, build
from wheelleg_exp.asset.report import LeftOut, Report

MOST = 20  # attributes that one file may have wrong
TRIALS = 200  # models that are compiled in search of one of them
MAPPINGS = ("extra", "option", "flag", "compiler")  # fields that hold MuJoCo's own attributes

Place = tuple[tuple[str, int], ...]
"""Where an item stands in a robot: fields and places in them, from the outside in."""


@dataclass(frozen=True)
class Suspect:
    """An attribute: the item that has it, where that stands, the field that holds it, its MJCF name and its value."""

    item: Any
    place: Place
    mapping: str
    key: str

    @property
    def value(self) -> object:
        """Return the attribute's value."""
        return getattr(self.item, self.mapping)[self.key]


def without_refused(robot: RobotDescription, report: Report) -> tuple[RobotDescription, Report]:
    """Return the robot without the attributes that MuJoCo refuses, and a report that names them.

    Raises:
        ModelRefused: MuJoCo refuses the robot for another reason, with MuJoCo's.
    """
    for _ in range(MOST):
        refusal = _refusal(robot, report.source)
        if refusal is None:
            break
        found = _culprit(robot, refusal, report.source)
        if found is None:
            raise refusal
        robot, report = _without(robot, found.place, found), _told(report, found, refusal)
    return robot, report


def _refusal(robot: RobotDescription, source: str) -> ModelRefused | None:
    assets = {file_name(mesh): obj_text(mesh).encode() for mesh in robot.meshes if len(mesh.faces)}
    try:
        build(Writer(robot, "").text(), assets, source)
    except ModelRefused as error:
        return error
    return None


def _culprit(robot: RobotDescription, refusal: ModelRefused, source: str) -> Suspect | None:
    """Return the attribute without which MuJoCo takes the robot, or complains of something else."""
    changed = None
    suspects = list(_suspects(robot))
    named = [found for found in suspects if f"'{getattr(found.item, 'name', '')}'" in refusal.message]
    for suspect in (named or suspects)[:TRIALS]:
        left = _refusal(_without(robot, suspect.place, suspect), source)
        if left is None:
            return suspect
        if changed is None and left.message != refusal.message:
            changed = suspect
    return changed


def _suspects(item: Any, place: Place = ()) -> Iterator[Suspect]:
    for entry in fields(item):
        value = getattr(item, entry.name)
        if entry.name in MAPPINGS:
            yield from (Suspect(item, place, entry.name, key) for key in value)
        elif isinstance(value, tuple) and value and is_dataclass(value[0]):
            for index, inner in enumerate(value):
                yield from _suspects(inner, (*place, (entry.name, index)))


def _without(item: Any, place: Place, suspect: Suspect) -> Any:
    if not place:
        kept = {key: value for key, value in getattr(item, suspect.mapping).items() if key != suspect.key}
        return replace(item, **{suspect.mapping: kept})
    (name, index), *rest = place
    inner = list(getattr(item, name))
    inner[index] = _without(inner[index], tuple(rest), suspect)
    return replace(item, **{name: tuple(inner)})


def _told(report: Report, found: Suspect, refusal: ModelRefused) -> Report:
    """Return the report with an attribute among what was left out, by the name that it has in the file."""
    path = getattr(found.item, "path", report.root)
    of_item = [item for item in report.mapped if item.path == path and item.became == found.key]
    name = of_item[0].name if of_item else found.key
    reason = "MuJoCo refuses it: " + refusal.message.partition(": ")[2]
    return replace(
        report,
        mapped=tuple(item for item in report.mapped if item not in of_item),
        left_out=(*report.left_out, LeftOut(name, reason, {path: str(found.value)})),
        warnings=(*report.warnings, f"{path}: {name} was left out: {reason}"),
    )
