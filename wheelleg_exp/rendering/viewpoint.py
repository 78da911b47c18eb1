"""From where a robot is seen: always the same side, near enough to fill the picture."""

from __future__ import annotations

import numpy as np

from wheelleg_exp.rendering.shapes import Array

AZIMUTH, ELEVATION = 142.0, -14.0  # degrees, as MuJoCo's camera has them
_FOV = np.radians(30.0)  # upright; render_model.FOV
_FILLED = 0.64  # of the picture's height and width: the rest is for arrows and captions


def distance(cloud: Array, aspect: float) -> float:
    """Return the distance at which a cloud of points about the origin fills its part of the picture."""
    right, up, back = axes()
    tall = _FILLED * np.tan(_FOV / 2)
    wide = tall * aspect
    return float(np.max(cloud @ back + np.maximum(np.abs(cloud @ right) / wide, np.abs(cloud @ up) / tall)))


def axes() -> tuple[Array, Array, Array]:
    """Return the camera's axes in the world: right, up, and back (towards the viewer)."""
    a, e = np.radians(AZIMUTH), np.radians(ELEVATION)
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), -forward
