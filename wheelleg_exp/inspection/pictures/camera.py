"""Where a recorded robot is seen from: near enough to fill the picture, following it without shaking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.pictures.recorded_scene import Motion
from wheelleg_exp.rendering import viewpoint
from wheelleg_exp.rendering.scene import Scene, points
from wheelleg_exp.rendering.shapes import Array

_SMOOTH_S = 0.2
_LOOKED_AT = 12


@dataclass(frozen=True)
class Camera:
    """A camera that keeps its distance, m, and direction; what it looks at moves: (n, 3), m, one a frame."""

    distance: float
    lookat: Array


def follow(scene: Scene, motion: Motion, rows: NDArray[np.intp], aspect: float) -> Camera:
    """Return a camera for the chosen frames of a motion.

    Args:
        scene: the shapes.
        motion: how they move.
        rows: the frames, in order.
        aspect: width of the picture over its height.
    """
    root = motion.pos[rows, scene.root]
    seen = rows[np.linspace(0, len(rows) - 1, min(len(rows), _LOOKED_AT)).round().astype(int)]
    clouds = [points(scene, motion.pos[i], motion.quat[i]) - motion.pos[i, scene.root] for i in seen]
    low = np.median([cloud.min(axis=0) for cloud in clouds], axis=0)
    high = np.median([cloud.max(axis=0) for cloud in clouds], axis=0)
    centre = np.array([0.0, 0.0, (low[2] + high[2]) / 2])
    distance = max(viewpoint.distance(cloud - centre, aspect) for cloud in clouds)
    return Camera(distance, _smoothed(root, motion.time[rows], scene.size) + centre)


def _smoothed(path: Array, time: Array, size: float) -> Array:
    """Return a path without its shaking; it is cut where the robot was put somewhere else."""
    jumped = np.linalg.norm(np.diff(path, axis=0), axis=1) > size
    cuts = np.flatnonzero(jumped) + 1
    parts = np.split(np.arange(len(path)), cuts)
    return np.concatenate([_gauss(path[part], time[part]) for part in parts if len(part)])


def _gauss(path: Array, time: Array) -> Array:
    if len(path) < 3:
        return path
    spacing = max(float(np.median(np.diff(time))), 1e-6)
    reach = max(1, int(np.ceil(3 * _SMOOTH_S / spacing)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * spacing / _SMOOTH_S) ** 2)
    padded = np.pad(path, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T], axis=1)
