"""What a recording tells in words: ends of episodes, pushes, and what happened to the recording itself."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP

if TYPE_CHECKING:
    from wheelleg_exp.recording.reader import Recording

LOG = "log"
_SPEAKER = re.compile(r"env (\d+): (.*)", re.DOTALL)
_BRANCH = re.compile(r"env_(\d+)/")


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


def read(recording: Recording) -> list[Event]:
    """Return all of them by step."""
    found = [
        e
        for entity in recording.entities()
        if _kind(entity) and recording.has_rows(entity)
        for e in _entity(recording, entity)
    ]
    return sorted(found, key=lambda event: -1 if event.step is None else event.step)


def _kind(entity: str) -> str | None:
    """Return the kind of words that an entity holds: ``env_3/log/episodes`` holds ``episodes``."""
    head, _, kind = _BRANCH.sub("", entity, count=1).rpartition("/")
    return kind if head == LOG else None


def _entity(recording: Recording, entity: str) -> list[Event]:
    kind, branch = _kind(entity) or "", _BRANCH.match(entity)
    fallback = int(branch.group(1)) if branch else None
    return [_event(row, kind, fallback) for row in recording.rows(entity).to_pylist() if row.get("text")]


def _event(row: dict[str, Any], kind: str, fallback: int | None) -> Event:
    text = str(row["text"][0])
    said = _SPEAKER.fullmatch(text)
    duration = row.get(SIM_TIME)
    return Event(
        kind=kind,
        text=said.group(2) if said else text,
        env_id=int(said.group(1)) if said else fallback,
        step=row.get(STEP),
        time_s=None if duration is None else duration.total_seconds(),
        iteration=row.get(ITERATION),
        level=str((row.get("level") or ["INFO"])[0]),
    )
