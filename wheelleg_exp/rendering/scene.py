"""What is drawn: moving bodies, what never moves, the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.rendering.shapes import Array, Shape, rotated


@dataclass(frozen=True)
class Ground:
    """The checkered plane: its height and the edge of a tile, m."""

    height: float
    tile: float


@dataclass(frozen=True)
class Scene:
    """What is drawn.

    Attributes:
        bodies: the shapes of each moving body, by name.
        fixed: shapes that never move.
        ground: the plane, or None.
        root: which body the eye follows.
        size: about how tall the robot stands, m.
    """

    bodies: Mapping[str, Sequence[Shape]]
    fixed: Sequence[Shape]
    ground: Ground | None
    root: int
    size: float


def points(scene: Scene, pos: Array, quat: Array) -> Array:
    """Return points (n, 3), m, between which the robot lies when its bodies are at (B, 3), (B, 4)."""
    found = [
        rotated(quat[b], np.concatenate([shape.corners() for shape in shapes])) + pos[b]
        for b, shapes in enumerate(scene.bodies.values())
        if shapes
    ]
    return np.concatenate(found)
