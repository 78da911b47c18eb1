"""Ray casters: height scanners and lidars, whose rays start at a body and hit the ground."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Literal

import mujoco
import torch

from wheelleg_exp.constraints import Interval, NonNegative, Positive, Targeted, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.class_members import alias_of
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.sensors.ray_patterns import PatternBase
from wheelleg_exp.sim.sensors.sensor_base import LazySensor, Mount, Offset, offset_fits, offset_pose
from wheelleg_exp.sim.terrain import GROUND_GROUP
from wheelleg_exp.state import Stateful

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot

_Axis = Literal["x", "y", "z"]


class RayCasterData(Stateful):
    """Measurements of a ray caster, with Isaac Lab's attribute names.

    Attributes:
        pos_w: position of the body with the drift of this episode, without the offset, m, (N, 3).
        quat_w: orientation of the body (w, x, y, z), (N, 4).
        ray_hits_w: points where the rays hit the ground, m, (N, R, 3); inf for a miss.
    """

    def __init__(self, num_envs: int, rays: int, device: torch.device) -> None:
        self.pos_w = self.buffer("pos_w", torch.zeros(num_envs, 3, device=device))
        self.quat_w = self.buffer("quat_w", torch.zeros(num_envs, 4, device=device))
        self.ray_hits_w = self.buffer("ray_hits_w", torch.zeros(num_envs, rays, 3, device=device))


@relation(offset_fits)
class RayCaster(LazySensor):
    """A sensor that casts rays from a body of the robot when ``data`` is read; only the ground stops the rays.

    Args:
        body_name: expression of the body.
        pattern: the rays.
        offset: ``pos``, m, shifts origins, and ``rot`` (w, x, y, z) rotates directions, before ``ray_alignment``.
        ray_alignment: ``base`` rotates the rays' origins and directions with the body, ``yaw`` rotates only their
            origins by the body's yaw, ``world`` rotates nothing.
        max_distance: longest ray, m.
        drift_range: range of a position error along each world axis, drawn at each reset, m.
        ray_cast_drift_range: errors drawn at each reset, m: ``x`` and ``y`` shift the rays' origins before
            ``ray_alignment`` applies, and ``z`` raises the hit points.
    """

    def __init__(
        self,
        body_name: str,
        pattern: Annotated[PatternBase, Targeted()],
        offset: Offset | None = None,
        ray_alignment: Literal["base", "yaw", "world"] = "base",
        max_distance: Positive = 1e6,
        drift_range: Interval = (0.0, 0.0),
        ray_cast_drift_range: Mapping[_Axis, Interval] | None = None,
        update_period: NonNegative = 0.0,
    ) -> None:
        super().__init__(update_period)
        if not isinstance(pattern, PatternBase):
            raise ConfigError("is not a pattern", key="pattern", expected="a _target_ of PatternBase")
        self._body, self._offset = body_name, offset
        self.pattern_cfg = pattern  # its name in Isaac Lab's ``sensor.cfg``
        self._alignment, self._max_distance = ray_alignment, max_distance
        cast = ray_cast_drift_range or {}
        self._drift_ranges = [drift_range] * 3 + [cast.get(axis, (0.0, 0.0)) for axis in ("x", "y", "z")]

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        super().add_to(spec, name, robot)
        self._mount = Mount(self._body, robot, f"{self.key}.body_name")
        self.body_names = [self._mount.body]

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        super().connect(sim, stream)
        starts, directions = self.pattern_cfg.checked_rays(sim.device)
        pos, quat = offset_pose(self._offset, sim.device)
        turn = rotation.quat_to_matrix(quat.unsqueeze(0))[0]
        directions = torch.nn.functional.normalize(directions, dim=1) @ turn.T
        self.num_rays = len(starts)
        one_point = bool((starts == starts[:1]).all())
        self._starts, self._directions = starts[: 1 if one_point else None] + pos, directions
        is_down = bool((self._directions == self._directions.new_tensor([0.0, 0.0, -1.0])).all())
        self._looks_down = is_down and self._alignment != "base"
        data = RayCasterData(sim.num_envs, self.num_rays, sim.device)
        self._data = self.child("_data", data, saved=self.update_period > 0.0)
        ranges = torch.tensor([list(pair) for pair in self._drift_ranges], device=sim.device)
        self._low, self._high = ranges.unbind(dim=1)
        self.drift = self.buffer("drift", torch.zeros(sim.num_envs, 6, device=sim.device))
        self._stream = stream() if bool(ranges.any()) else None

    device = alias_of("_sim.device", "Device of the sensor's tensors.")

    @property
    def rays(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Origins, m, and unit directions of rays in the sensor's frame, (R, 3); equal origins are stored as (1, 3)."""
        return self._starts, self._directions

    def reset(self, env_ids: torch.Tensor) -> None:
        super().reset(env_ids)
        if self._stream is not None:
            self.drift[env_ids] = rotation.uniform(self._low, self._high, len(env_ids), self._stream)

    def sense(self, ids: torch.Tensor | slice) -> None:
        drift = self.drift[ids]
        pos = self._mount.pos_w[ids] + drift[:, :3]
        self._data.pos_w[ids] = pos
        self._data.quat_w[ids] = self._mount.quat_w[ids]
        starts, directions, far = self._cast(ids, pos, drift)
        far = far.unsqueeze(2)
        hits = torch.where((far >= 0.0) & (far <= self._max_distance), starts + far * directions, torch.inf)
        hits[..., 2] += drift[:, 5:]
        self._data.ray_hits_w[ids] = hits

    def _cast(
        self, ids: torch.Tensor | slice, pos: torch.Tensor, drift: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the rays' origins (n, R, 3), m, directions (n, R, 3), and lengths (n, R), m, negative without a hit.

        ``pos`` (n, 3) is the body's position, m; ``drift`` (n, 6) are the position errors, m.
        """
        turn = self._turn(ids)
        moved = rotation.rotate(turn, drift[:, 3:])
        moved[:, 2] = 0.0
        starts = self._starts @ turn.transpose(1, 2) + (pos + moved).unsqueeze(1)
        starts = starts.expand(-1, self.num_rays, -1)
        directions = self._directions.expand_as(starts)
        if self._alignment == "base":
            directions = directions @ turn.transpose(1, 2)
        if self._looks_down and self.terrain.has_formula:
            return starts, directions, starts[..., 2] - self.terrain.height_at(starts[..., :2])
        only = None if isinstance(ids, slice) else ids
        return starts, directions, self._sim.ray(starts, directions, (GROUND_GROUP,), only).float()

    def _turn(self, ids: torch.Tensor | slice) -> torch.Tensor:
        """Return the matrices (n, 3, 3) that rotate the ray pattern into world axes."""
        matrix = self._mount.rot_w[ids]
        if self._alignment == "base":
            return matrix
        turn = torch.eye(3, device=matrix.device).repeat(len(matrix), 1, 1)
        if self._alignment == "yaw":
            yaw = torch.atan2(matrix[:, 1, 0], matrix[:, 0, 0])
            turn[:, 0, 0] = turn[:, 1, 1] = yaw.cos()
            turn[:, 1, 0] = yaw.sin()
            turn[:, 0, 1] = -turn[:, 1, 0]
        return turn
