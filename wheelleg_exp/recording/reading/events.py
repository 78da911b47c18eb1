"""What a recording tells in words: ends of episodes, pushes, and what happened to the recording itself."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from wheelleg_exp.recording.layout import BRANCH, ITERATION, LOG, SIM_TIME, STEP
from wheelleg_exp.recording.reading.plain import LONGEST, plain
from wheelleg_exp.recording.reading.rows import EntityRows

_COLUMNS = ("text", "level", STEP, SIM_TIME, ITERATION)
_SPEAKER = re.compile(r"env ([0-9]{1,9}): (.*)", re.DOTALL)


@dataclass(frozen=True)
class Event:
    """Something that was told in words.

    Attributes:
        kind: ``episodes``, ``events`` or ``recording``.
        text: what, without the environment.
        env_id: of which environment; None when of none.
        step: control step; None when it is not known.
        time_s: simulated time; None when it is not known.
        iteration: training iteration; None outside of training.
        level: severity by rerun's names.
    """

    kind: str
    text: str
    env_id: int | None
    step: int | None
    time_s: float | None
    iteration: int | None
    level: str


def read(rows: EntityRows) -> list[Event]:
    """Return all of them by step."""
    told = (entity for entity in rows.entities() if _kind(entity) and rows.has_rows(entity))
    found = [event for entity in told for event in _entity(entity, rows.rows(entity))]
    return sorted(found, key=lambda event: -1 if event.step is None else event.step)


def _kind(entity: str) -> str | None:
    """Return the kind of words that an entity holds: ``env_3/log/episodes`` holds ``episodes``."""
    head, _, kind = BRANCH.sub("", entity, count=1).rpartition("/")
    return kind if head == LOG else None


def _entity(entity: str, table: pa.Table) -> list[Event]:
    kind, branch = _kind(entity) or "", BRANCH.match(entity)
    fallback = int(branch.group(1)) if branch else None
    columns = (plain(table.column(n)) if n in table.column_names else [None] * len(table) for n in _COLUMNS)
    rows = (dict(zip(_COLUMNS, row, strict=True)) for row in zip(*columns, strict=True))
    return [_event(row, kind, fallback) for row in rows if row["text"]]


def _event(row: dict[str, Any], kind: str, fallback: int | None) -> Event:
    text = str(row["text"][0])[:LONGEST]
    said = _SPEAKER.fullmatch(text)
    return Event(
        kind=kind,
        text=said.group(2) if said else text,
        env_id=int(said.group(1)) if said else fallback,
        step=row[STEP],
        time_s=None if row[SIM_TIME] is None else row[SIM_TIME] * 1e-9,
        iteration=row[ITERATION],
        level=str((row["level"] or ["INFO"])[0]),
    )
