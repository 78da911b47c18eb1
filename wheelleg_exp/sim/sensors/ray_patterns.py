"""Patterns of rays: grids, lidars, and the pixels of a pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch

from wheelleg_exp.constraints import AtMost, Broken, Count, Interval, Length, NotAllZero, Positive, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.machine import require_memory
from wheelleg_exp.terms.term_errors import blamed, code_place, described, dotted_name

Rays = tuple[torch.Tensor, torch.Tensor]
_TURN = 2 * math.pi


class PatternBase:
    """A pattern of rays: one YAML node in a ray caster, from this package or user-defined."""

    def rays(self, device: torch.device) -> Rays:
        """Return the origins, m, (R, 3), and the directions (R, 3) of R rays; no direction may have the length 0."""
        raise NotImplementedError("a pattern needs 'rays(device)'")

    def checked_rays(self, device: torch.device) -> Rays:
        """Return the rays of a pattern; raise ConfigError if the pattern's method ``rays`` has an invalid result."""
        if type(self).__module__ == __name__:
            # Tensors on torch's meta device have a shape but no memory, which is enough for counting the rays.
            count = len(self.rays(torch.device("meta"))[0])
            require_memory(24 * count, "pattern", f"{count:,} rays")
        with blamed("pattern", self):
            given = self.rays(device)
        if not isinstance(given, tuple) or len(given) != 2:
            found = described(given)
        elif not all(isinstance(part, torch.Tensor) for part in given):
            found = " and ".join(map(described, given))
        elif given[0].shape != given[1].shape or given[0].ndim != 2 or given[0].shape[1] != 3 or not len(given[0]):
            found = f"shapes {tuple(given[0].shape)} and {tuple(given[1].shape)}"
        elif not bool((given[1].isfinite() & given[0].isfinite()).all() and (given[1].norm(dim=1) > 0.0).all()):
            found = "a direction of length 0, or numbers that are not finite"
        else:
            return given
        expected = "a tuple of origins and directions, tensors of shape (R, 3) each, no direction of length 0"
        message = f"'{dotted_name(self)}.rays' returns {found}"
        raise ConfigError(message, key="pattern", where=code_place(self.rays), expected=expected)


@dataclass(eq=False)
class GridPattern(PatternBase):
    """Parallel rays that start on a grid centred on the sensor; the outermost rays start on the edges of the grid.

    Args:
        resolution: distance between neighbouring rays, m.
        size: length along x and width along y, m.
        direction: direction of all rays.
        ordering: index order of the rays: x varies fastest (``xy``), or y (``yx``).
    """

    resolution: Positive
    size: Annotated[Sequence[float], Length(2)]
    direction: Annotated[Sequence[float], Length(3), NotAllZero()] = (0.0, 0.0, -1.0)
    ordering: Literal["xy", "yx"] = "xy"

    def rays(self, device: torch.device) -> Rays:
        x, y = (torch.arange(-length / 2, length / 2 + 1e-9, self.resolution, device=device) for length in self.size)
        grid = torch.meshgrid(x, y, indexing="xy" if self.ordering == "xy" else "ij")
        starts = torch.stack((*(axis.flatten() for axis in grid), torch.zeros(grid[0].numel(), device=device)), dim=1)
        return starts, torch.tensor(self.direction, device=device).expand_as(starts).clone()


def _angles_in_radians(vertical_fov_range: Sequence[float], horizontal_fov_range: Sequence[float]) -> Iterator[Broken]:
    for name, given in (("vertical_fov_range", vertical_fov_range), ("horizontal_fov_range", horizontal_fov_range)):
        if max(map(abs, given)) > _TURN + 1e-6:
            yield Broken(name, f"{list(given)!r} is more than a full turn", "[low, high] in radians")


@relation(_angles_in_radians)
@dataclass(eq=False)
class LidarPattern(PatternBase):
    """Rays of a rotating lidar: beams at several elevations that rotate about z, all from one point.

    Args:
        channels: number of beams.
        vertical_fov_range: elevation of the lowest and the highest beam, rad.
        horizontal_fov_range: first and last azimuth from x towards y, rad; a full turn leaves out the last one.
        horizontal_res: largest angle between neighbouring azimuths, rad.
    """

    channels: Count
    vertical_fov_range: Interval
    horizontal_fov_range: Interval
    horizontal_res: Positive

    def rays(self, device: torch.device) -> Rays:
        low, high = self.horizontal_fov_range
        steps = math.ceil((high - low) / self.horizontal_res - 1e-9)
        azimuth = torch.linspace(low, high, steps + 1, device=device)
        azimuth = azimuth[:-1] if abs(high - low - _TURN) < 1e-6 else azimuth
        lowest, highest = self.vertical_fov_range
        elevation = torch.linspace(lowest, highest, self.channels, device=device)
        return _from_origin(*torch.meshgrid(elevation, azimuth, indexing="ij"))


class BpearlPattern(PatternBase):
    """Rays of a Robosense RS-Bpearl lidar, a hemisphere above the sensor's xy plane.

    Args:
        horizontal_fov: range of azimuths, centred on x, rad.
        horizontal_res: angle between neighbouring azimuths, rad.
        vertical_ray_angles: elevation of each beam, rad; null means the device's 32 beams.
    """

    def __init__(
        self,
        horizontal_fov: Annotated[Positive, AtMost(_TURN)] = _TURN,
        horizontal_res: Positive = _TURN / 36,
        vertical_ray_angles: Sequence[float] | None = None,
    ) -> None:
        self._fov, self._resolution = horizontal_fov, horizontal_res
        own = [math.radians(89.5 - 2.8125 * beam) for beam in range(32)]
        self._elevations = own if vertical_ray_angles is None else list(vertical_ray_angles)

    def rays(self, device: torch.device) -> Rays:
        count = math.ceil(self._fov / self._resolution - 1e-9)
        azimuth = -self._fov / 2 + self._resolution * torch.arange(count, device=device)
        elevation = torch.tensor(self._elevations, device=device)
        azimuth, elevation = torch.meshgrid(azimuth, elevation, indexing="ij")
        return _from_origin(elevation, azimuth + math.pi)


class PinholePattern(PatternBase):
    """Rays through the centres of a camera's pixels, row by row from the upper left; the camera looks along x.

    ``intrinsics`` contains the rows of the intrinsic matrix, in pixels.

    Args:
        focal_length: in the unit of the apertures; only their ratio matters.
        horizontal_aperture: width of the image plane.
        vertical_aperture: height of the image plane; null makes pixels square.
        horizontal_aperture_offset: offset of the image's centre to the right, in focal lengths.
        vertical_aperture_offset: offset of the image's centre downwards, in focal lengths.
    """

    def __init__(
        self,
        width: Count,
        height: Count,
        focal_length: Positive = 24.0,
        horizontal_aperture: Positive = 20.955,
        vertical_aperture: Positive | None = None,
        horizontal_aperture_offset: float = 0.0,
        vertical_aperture_offset: float = 0.0,
    ) -> None:
        self.width, self.height = width, height
        vertical = horizontal_aperture * height / width if vertical_aperture is None else vertical_aperture
        focal = width * focal_length / horizontal_aperture, height * focal_length / vertical
        self.intrinsics = (
            (focal[0], 0.0, width / 2 + horizontal_aperture_offset * focal[0]),
            (0.0, focal[1], height / 2 + vertical_aperture_offset * focal[1]),
            (0.0, 0.0, 1.0),
        )

    def rays(self, device: torch.device) -> Rays:
        rows, columns = (torch.arange(count, device=device) for count in (self.height, self.width))
        v, u = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
        (f_x, _, c_x), (_, f_y, c_y), _ = self.intrinsics
        right, down = (u.flatten() - c_x) / f_x, (v.flatten() - c_y) / f_y
        directions = torch.stack((torch.ones_like(right), -right, -down), dim=1)
        return torch.zeros_like(directions), torch.nn.functional.normalize(directions, dim=1)


def _from_origin(elevation: torch.Tensor, azimuth: torch.Tensor) -> Rays:
    level = elevation.cos()
    parts = (level * azimuth.cos(), level * azimuth.sin(), elevation.sin())
    directions = torch.stack(parts, dim=-1).reshape(-1, 3)
    return torch.zeros_like(directions), directions
