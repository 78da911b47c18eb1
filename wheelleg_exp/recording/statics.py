"""What a recording says of itself: its properties, its purpose, and the environments in it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from wheelleg_exp.recording.layout import SIM_TIME, STEP, TRAINING

if TYPE_CHECKING:
    from wheelleg_exp.recording.reader import Recording

PROPERTIES = "__properties"
OWN = "wheelleg"
_BRANCH = re.compile(r"env_(\d+)")
_BRANCH_PATH = re.compile(r"^env_\d+/")


def properties(recording: Recording, entities: Iterable[str]) -> Mapping[str, Mapping[str, Any]]:
    """Return the properties by name; a list of one stands for itself."""
    found: dict[str, Mapping[str, Any]] = {}
    for entity in entities:
        root, _, name = entity.partition("/")
        if root == PROPERTIES:
            values = recording.static(entity)
            found[name or "RecordingInfo"] = {k: v[0] if len(v) == 1 else v for k, v in values.items()}
    return found


def purpose(recording: Recording) -> str | None:
    """Return what it was recorded for; a recording without properties is of our first format, or another tool's."""
    said = recording.properties.get(OWN, {}).get("purpose")
    if said is not None:
        return str(said)
    parts = {_BRANCH_PATH.sub("", entity).split("/")[0] for entity in recording.entities()}
    return "training" if TRAINING in parts else "play" if {"rewards", "terminations"} <= parts else None


def env_ids(recording: Recording) -> list[int]:
    """Return the recorded environments."""
    said = recording.properties.get(OWN, {}).get("env_ids")
    if said is not None:
        return [int(i) for i in (said if isinstance(said, list) else [said])]
    if recording.branches:
        return recording.branches
    spoke = [event.env_id for event in recording.events() if event.env_id is not None]
    return spoke[:1] or [0]


def branch(recording: Recording, env_id: int) -> str:
    """Return the path in front of an environment's data."""
    return f"env_{env_id}" if env_id in recording.branches else ""


def step_dt(recording: Recording) -> float | None:
    """Return the simulated time of a control step, s."""
    said = recording.properties.get(OWN, {}).get("step_dt")
    if said is not None:
        return float(said)
    for entity in recording.entities():
        if recording.has_rows(entity):
            table = recording.rows(entity)
            if {STEP, SIM_TIME} <= set(table.column_names):
                steps = np.asarray(table.column(STEP))
                times = np.asarray(table.column(SIM_TIME).cast("int64"))
                if len(steps) and steps[-1] > 0:
                    return float(times[-1] / steps[-1] * 1e-9)
    return None


def branches(recording: Recording) -> list[int]:
    """Return the environments that have a branch of their own."""
    matches = [_BRANCH.fullmatch(entity.split("/")[0]) for entity in recording.entities()]
    return sorted({int(match.group(1)) for match in matches if match})
