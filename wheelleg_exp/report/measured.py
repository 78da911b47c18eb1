"""What was measured in a recording: tracking errors, contact forces, use of effort, as tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from wheelleg_exp.report.blocks import Block, Cell, Note, Table
from wheelleg_exp.report.words import exact, number, percent

if TYPE_CHECKING:
    from wheelleg_exp.inspection.measures import EffortUse, ForceExtreme, TrackingError
    from wheelleg_exp.recording.reader import Recording

_UNITS = {"v_x": "m/s", "v_y": "m/s", "w_z": "rad/s"}
_NOTES = 3
_HIGH, _FULL = 0.01, 0.1  # shares of the time at the effort limit that are worth a colour


@dataclass(frozen=True)
class Measured:
    """Tables of a recording; a subject that it does not hold has none."""

    tracking: Sequence[Block] = ()
    forces: Sequence[Block] = ()
    efforts: Sequence[Block] = ()


def measured(recording: Recording) -> Measured:
    """Return the tables of a recording.

    Raises:
        RunDirectoryError: rows are damaged.
    """
    from wheelleg_exp.inspection.summary import summarize

    found = summarize(recording)
    return Measured(_tracking(found.tracking), _forces(found.forces), _efforts(found.efforts))


def health(recording: Recording) -> list[Block]:
    """Return what is missing in a recording and why, and what mends its file; nothing when it is whole."""
    told = [Note(f"Of the recording: {event.text}.") for event in recording.events("recording")[-_NOTES:]]
    if recording.health.is_whole:
        return list(told)
    what = "; ".join(line.rstrip(". ") for line in recording.health.lines())
    mends = "'wheelleg inspect --repair' writes a copy that holds the rest and opens everywhere"
    return [Note(f"The recording is {what}. What can be read of it is shown; {mends}."), *told]


def _tracking(errors: Sequence[TrackingError]) -> list[Block]:
    rows = [
        [Cell(e.name, code=True), *(Cell(_with(value, e.name), number=True) for value in (e.rmse, e.mean, e.largest))]
        for e in errors
    ]
    columns = ("Velocity", "RMS error", "Mean error", "Largest error")
    return [Table("Velocities against their commands", columns, rows)] if rows else []


def _forces(forces: Sequence[ForceExtreme]) -> list[Block]:
    touched = [force for force in forces if force.contact_share > 0]
    rows = [
        [
            Cell(force.body, code=True),
            Cell(f"{number(force.mean_n)} N", number=True),
            Cell(f"{number(force.largest_n)} N", number=True),
            Cell(percent(force.contact_share), bar=force.contact_share),
        ]
        for force in touched
    ]
    columns = ("Body", "Mean force", "Largest within a step", "In contact")
    return [Table("Contact forces of the bodies that touched something", columns, rows)] if rows else []


def _efforts(efforts: Sequence[EffortUse]) -> list[Block]:
    rows = [
        [
            Cell(use.joint, code=True),
            Cell(number(use.rms), number=True),
            Cell(number(use.largest), number=True),
            Cell(exact(use.limit), number=True),
            _saturated(use.saturated_share),
        ]
        for use in efforts
    ]
    columns = ("Joint", "RMS effort", "Largest", "Limit", "At its limit")
    return [Table("Efforts of the joints (N·m, or N)", columns, rows)] if rows else []


def _saturated(share: float | None) -> Cell:
    tone = "" if share is None or share < _HIGH else "warn" if share < _FULL else "bad"
    return Cell("–") if share is None else Cell(percent(share), bar=share, tone=tone)  # type: ignore[arg-type]


def _with(value: float, name: str) -> str:
    return f"{number(value)} {_UNITS.get(name, '')}".strip()
