"""What was measured in a recording: tracking errors, contact forces, use of effort, as tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from wheelleg_exp.definitions.recorded import headings
from wheelleg_exp.report.blocks import Block, Cell, Note, Table, Text
from wheelleg_exp.report.words import capital, counted, exact, number, percent

if TYPE_CHECKING:
    from wheelleg_exp.inspection.questions.measures import EffortUse, ForceExtreme, TrackingError
    from wheelleg_exp.inspection.questions.summary import Summary
    from wheelleg_exp.recording.reading.reader import Recording

_UNITS = {"v_x": "m/s", "v_y": "m/s", "w_z": "rad/s"}
_NOTES = 3
_HIGH, _FULL = 0.01, 0.1  # shares of the time at the effort limit that are worth a colour


@dataclass(frozen=True)
class Measured:
    """Tables of a recording, and what they are of; a subject that it does not hold has none."""

    scope: Sequence[Block] = ()
    tracking: Sequence[Block] = ()
    forces: Sequence[Block] = ()
    efforts: Sequence[Block] = ()


def measured(recording: Recording) -> Measured:
    """Return the tables of a recording.

    Raises:
        RunDirectoryError: rows are damaged.
    """
    from wheelleg_exp.inspection.questions.summary import summarize

    found = summarize(recording)
    return Measured(_scope(found), _tracking(found.tracking), _forces(found.forces), _efforts(found.efforts))


def _scope(found: Summary) -> list[Block]:
    """Return what curves and tables are of: of a play one environment alone, but every episode of it."""
    steps, count = (found.frames or (0, 0))[0], found.figures.count
    which = ", ".join(map(str, found.env_ids))
    many = len(found.env_ids) > 1
    whose = f"The curves are of environment {found.env_ids[0]}, the tables of environments {which}" if many else ""
    whose = whose or f"The curves and tables are of environment {which} alone"
    return [Text(f"{whose}: all {counted(steps, 'recorded step')}, of {counted(count, 'episode')}.")] if steps else []


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
    columns = ("Velocity", *map(capital, headings("tracking", "rmse", "mean", "largest")))
    return [Table("Velocities against their commands", columns, rows)] if rows else []


def _forces(forces: Sequence[ForceExtreme]) -> list[Block]:
    touched = [force for force in forces if force.contact_share > 0]
    rows = [
        [
            Cell(force.body, code=True),
            Cell(number(force.mean_n), number=True),
            Cell(number(force.largest_n), number=True),
            Cell(percent(force.contact_share), bar=force.contact_share),
        ]
        for force in touched
    ]
    columns = ("Body", *map(capital, headings("contact forces", "mean_n", "largest_n", "contact_share")))
    what = "mean and contact at the end of steps, largest in the sensor's history"
    return [Table(f"Contact forces of the bodies that touched something: {what}", columns, rows)] if rows else []


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
    columns = ("Joint", *map(capital, headings("efforts")))
    return [Table("Efforts of the joints", columns, rows)] if rows else []


def _saturated(share: float | None) -> Cell:
    tone = "" if share is None or share < _HIGH else "warn" if share < _FULL else "bad"
    return Cell("–") if share is None else Cell(percent(share), bar=share, tone=tone)  # type: ignore[arg-type]


def _with(value: float, name: str) -> str:
    return f"{number(value)} {_UNITS.get(name, '')}".strip()
