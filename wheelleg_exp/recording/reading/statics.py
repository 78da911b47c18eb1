"""What a recording says of itself: its properties, its purpose, and the environments in it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from wheelleg_exp.recording.layout import BRANCH, OWN, PROPERTIES, SIM_TIME, STEP, TRAINING
from wheelleg_exp.recording.reading import events
from wheelleg_exp.recording.reading.plain import LONGEST, as_number
from wheelleg_exp.recording.reading.rows import EntityRows

Properties = Mapping[str, Mapping[str, Any]]


_MOST_ENVS = 1 << 12


def properties(rows: EntityRows, entities: Iterable[str]) -> Properties:
    """Return the properties by name; a list of one stands for itself."""
    found: dict[str, Mapping[str, Any]] = {}
    for entity in entities:
        root, _, name = entity.partition("/")
        if root == PROPERTIES:
            values = rows.static(entity)
            found[name or "RecordingInfo"] = {k: _told(v[0] if len(v) == 1 else v) for k, v in values.items()}
    return found


def _told(value: Any) -> Any:
    """Return a property's value as words, numbers, lists and mappings."""
    if isinstance(value, list):
        return [_told(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _told(item) for key, item in value.items()}
    return value if isinstance(value, int | float | None) else str(value)[:LONGEST]


def purpose(properties: Properties, entities: Iterable[str]) -> str | None:
    """Return what it was recorded for; a recording without properties is of our first format, or another tool's."""
    said = properties.get(OWN, {}).get("purpose")
    if isinstance(said, str):
        return said
    parts = {BRANCH.sub("", entity).split("/")[0] for entity in entities}
    return "training" if TRAINING in parts else "play" if {"rewards", "terminations"} <= parts else None


def env_ids(rows: EntityRows, properties: Properties, branches: list[int]) -> list[int]:
    """Return the recorded environments."""
    said = properties.get(OWN, {}).get("env_ids")
    ids = said if isinstance(said, list) else [said]
    if ids and len(ids) <= _MOST_ENVS and all(isinstance(i, int) and i >= 0 for i in ids):
        return list(dict.fromkeys(ids))
    if branches:
        return branches
    spoke = [event.env_id for event in events.read(rows) if event.env_id is not None]
    return spoke[:1] or [0]


def step_dt(rows: EntityRows, properties: Properties) -> float | None:
    """Return the simulated time of a control step, s."""
    said = properties.get(OWN, {}).get("step_dt")
    if (given := as_number(said)) is not None and math.isfinite(given) and given > 0:
        return given
    for entity in rows.entities():
        if rows.has_rows(entity):
            table = rows.rows(entity)
            if {STEP, SIM_TIME} <= set(table.column_names):
                steps = np.asarray(table.column(STEP))
                times = np.asarray(table.column(SIM_TIME).cast("int64").fill_null(0))
                if len(steps) and steps[-1] > 0 and times[-1] > 0:
                    return float(times[-1] / steps[-1] * 1e-9)
    return None


def branches(entities: Iterable[str]) -> list[int]:
    """Return the environments that have a branch of their own."""
    matches = [BRANCH.match(f"{entity}/") for entity in entities]
    return sorted({int(match.group(1)) for match in matches if match})[:_MOST_ENVS]
