"""How large a recording becomes, before it is written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco

MEGABYTE = 1_000_000
# Bytes: a chunk's own description and its place in the file's index, measured; the three times of a row, a transform.
_CHUNK, _TIMES, _TRANSFORM, _NUMBER = 1300 + 500, 24, 28, 8
_FACE, _CELL, _TEXTS = 150, 40, 2 * MEGABYTE


@dataclass(frozen=True)
class Cost:
    """An estimate from above of what frames take, without the compression.

    Attributes:
        entities: entities that get a row a frame.
        numbers: numbers of a frame.
        bodies: bodies whose pose is in a frame.
    """

    entities: int
    numbers: int
    bodies: int

    def frame(self, rows_together: int) -> float:
        """Return the bytes of a frame when so many rows are written at a time."""
        entities = self.entities + self.bodies
        content = _NUMBER * self.numbers + _TRANSFORM * self.bodies + _TIMES * entities
        return content + _CHUNK * entities / rows_together


def total(costs: Iterable[Cost]) -> Cost:
    """Return the cost of several environments together."""
    found = list(costs)
    return Cost(sum(c.entities for c in found), sum(c.numbers for c in found), sum(c.bodies for c in found))


def surroundings(model: mujoco.MjModel, envs: int) -> float:
    """Return the bytes of what is written once: shapes, and an allowance for texts and names."""
    return envs * (_FACE * model.nmeshface + _CELL * model.nhfielddata) + _TEXTS
