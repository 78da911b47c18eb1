"""Places on a tile that are flat enough to begin or to end on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from wheelleg_exp.constraints import Bounds, Count, NonNegative, Positive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state import Kept

Array = npt.NDArray[np.float64]
_POINTS = 10  # on each ring around a place, as in Isaac Lab
_ROUNDS = 1000


@dataclass(kw_only=True)
class FlatPatches(Kept):
    """Which places of a tile are taken: those around which the ground is level, drawn until there are enough.

    The height of a place is that of its middle. The ranges are seen from the tile's origin, and cut to the tile.

    Args:
        num_patches: how many a tile, P.
        patch_radius: radius of the ring, m, or of several, on which the ground is looked at.
        max_height_diff: greatest difference of heights on a place, m.
        x_range: m.
        y_range: m.
        z_range: lowest and highest point of a place, m.
    """

    num_patches: Count
    patch_radius: Positive | Sequence[Positive]
    max_height_diff: NonNegative
    x_range: Bounds = (-np.inf, np.inf)
    y_range: Bounds = (-np.inf, np.inf)
    z_range: Bounds = (-np.inf, np.inf)

    def find(
        self,
        height_at: Callable[[Array], Array],
        origin: Array,
        size: Sequence[float],
        rng: np.random.Generator,
        key: str,
    ) -> Array:
        """Return places (P, 3) as seen from the tile's origin, m.

        Args:
            height_at: heights (...) at points (..., 2) of the tile, whose centre is 0.
            origin: the tile's origin (3,).
            size: edges of the tile.
            rng: the ground's source of chance.
            key: the config key of this, for the message.

        Raises:
            ConfigError: the tile is nowhere flat enough.
        """
        low, high = np.transpose([self._bounds(axis, origin, size) for axis in range(2)])
        radii = np.atleast_1d(np.asarray(self.patch_radius, dtype=float))
        angles = np.linspace(0.0, 2 * np.pi, _POINTS, endpoint=False)
        ring = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        offsets = np.concatenate((np.zeros((1, 2)), (radii[:, None, None] * ring).reshape(-1, 2)))
        found = np.zeros((0, 3))
        for _ in range(_ROUNDS):
            places = rng.uniform(low, high, (self.num_patches, 2))
            heights = height_at(places[:, None] + offsets) - origin[2]
            fits = (heights >= self.z_range[0]) & (heights <= self.z_range[1])
            flat = fits.all(axis=1) & (np.ptp(heights, axis=1) <= self.max_height_diff + 1e-9)
            found = np.concatenate((found, np.column_stack((places - origin[:2], heights[:, 0]))[flat]))
            if len(found) >= self.num_patches:
                return found[: self.num_patches]
        raise ConfigError(
            f"{len(found)} of {self.num_patches} flat places were found in {_ROUNDS * self.num_patches:,} tries",
            key=key,
            expected="a smaller patch_radius, a larger max_height_diff or wider ranges",
        )

    def _bounds(self, axis: int, origin: Array, size: Sequence[float]) -> tuple[float, float]:
        low, high = (self.x_range, self.y_range)[axis]
        half = size[axis] / 2
        return max(low + origin[axis], -half), max(min(high + origin[axis], half), max(low + origin[axis], -half))
