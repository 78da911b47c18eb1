"""A depth camera of rays: distances to the ground through the pixels of a pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import torch

from wheelleg_exp.constraints import NonNegative, NotEmpty, Positive, Targeted, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.sensors.camera_data import (
    CameraData,
    CameraOffset,
    DepthClipping,
    camera_offset_fits,
    clipped,
    in_world_convention,
)
from wheelleg_exp.sim.sensors.mounting import offset_pose
from wheelleg_exp.sim.sensors.patterns import PinholePattern
from wheelleg_exp.sim.sensors.ray_caster import RayCaster

RayDepth = Literal["distance_to_image_plane", "distance_to_camera", "depth"]


@relation(camera_offset_fits)
class RayCasterCamera(RayCaster):
    """A depth camera on a body that sees the ground and nothing else, for any number of environments.

    As Isaac Lab's; it needs nothing that draws. A pixel's distance is that of the ray through its centre.

    Args:
        body_name: expression of the body.
        pattern: the pixels, a ``PinholePattern``.
        data_types: ``distance_to_image_plane`` or ``depth`` (m, along the axis), ``distance_to_camera`` (m, along the
            pixel's ray).
        offset: ``pos``, m, (x, y, z), and ``rot``, (w, x, y, z), in the body's frame, of axes that ``convention``
            names: ``world`` looks along x, up is z; ``ros`` along z, up is -y; ``opengl`` along -z, up is y.
        max_distance: farthest distance that is seen, m.
        depth_clipping_behavior: what a distance is where nothing is seen: ``none`` inf, ``zero`` 0, ``max`` the
            farthest.
        update_period: time between two measurements, s; 0 shows the present state at every reading.
    """

    _data: CameraData

    def __init__(
        self,
        body_name: str,
        pattern: Annotated[PinholePattern, Targeted()],
        data_types: Annotated[Sequence[RayDepth], NotEmpty()] = ("distance_to_image_plane",),
        offset: CameraOffset | None = None,
        max_distance: Positive = 1e6,
        depth_clipping_behavior: DepthClipping = "none",
        update_period: NonNegative = 0.0,
    ) -> None:
        if not isinstance(pattern, PinholePattern):
            raise ConfigError("has no pixels", key="pattern", expected="a _target_ of PinholePattern")
        super().__init__(
            body_name,
            pattern,
            offset=in_world_convention(offset),
            ray_alignment="base",
            max_distance=max_distance,
            update_period=update_period,
        )
        self._pinhole, self._data_types = pattern, tuple(data_types)
        self._clipping: DepthClipping = depth_clipping_behavior

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of a picture."""
        return self._pinhole.height, self._pinhole.width

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled."""
        super().connect(sim, stream)
        self._offset_pos, self._offset_quat = offset_pose(self._offset, sim.device)
        self._cosines = self._pinhole.rays(sim.device)[1][:, 0]
        self._data = CameraData(sim.num_envs, self._pinhole, sim.device)
        for kind in self._data_types:
            self._data.add_output(kind, 1, torch.float32)

    def sense(self, ids: torch.Tensor | slice) -> None:
        """Cast the rays of some environments."""
        data, pos, quat = self._data, self._mount.pos_w[ids], self._mount.quat_w[ids]
        offset = self._offset_pos.expand(len(pos), 3)
        data.pos_w[ids] = pos + rotation.rotate(self._mount.rot_w[ids], offset)
        data.quat_w_world[ids] = rotation.quat_mul(quat, self._offset_quat.expand_as(quat))
        _, _, far = self._cast(ids, pos, self.drift[ids])
        far = far.masked_fill(far < 0.0, math.inf)
        for kind in self._data_types:
            depth = far if kind == "distance_to_camera" else far * self._cosines
            depth = clipped(depth, self._max_distance, self._clipping)
            data.output[kind][ids] = depth.view(-1, *self.image_shape, 1)
