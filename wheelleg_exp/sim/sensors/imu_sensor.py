"""An inertial measurement unit: orientation, angular velocity and acceleration of its frame, with errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import mujoco
import torch

from wheelleg_exp.constraints import Interval, Length, NonNegative, Targeted, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.sim.sensors.sensor_base import Mount, Offset, SensorBase, offset_fits, offset_pose
from wheelleg_exp.state import Stateful

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot


@dataclass
class ImuNoise:
    """Noise and bias of an accelerometer (m/s^2) or a gyroscope (rad/s), drawn independently for each axis.

    Args:
        std: standard deviation of the white noise of each measurement.
        bias_range: range of the bias, drawn at each reset.
        bias_walk: standard deviation of the bias's random walk after 1 s.
    """

    std: NonNegative = 0.0
    bias_range: Interval = (0.0, 0.0)
    bias_walk: NonNegative = 0.0


class ImuData(Stateful):
    """Measurements of an IMU, with Isaac Lab's attribute names; the suffix ``_b`` means the axes of the IMU.

    Attributes:
        pos_w: position, m, (N, 3).
        quat_w: orientation (w, x, y, z), (N, 4).
        projected_gravity_b: unit direction of gravity, (N, 3); upright is (0, 0, -1).
        lin_vel_b: velocity, m/s, (N, 3).
        ang_vel_b: angular velocity with the gyroscope's errors, rad/s, (N, 3).
        lin_acc_b: acceleration plus the gravity bias, with the accelerometer's errors, m/s^2, (N, 3).
        ang_acc_b: angular acceleration, rad/s^2, (N, 3).
    """

    pos_w: torch.Tensor
    projected_gravity_b: torch.Tensor
    lin_vel_b: torch.Tensor
    ang_vel_b: torch.Tensor
    lin_acc_b: torch.Tensor
    ang_acc_b: torch.Tensor

    def __init__(self, num_envs: int, device: torch.device) -> None:
        names = ("pos_w", "projected_gravity_b", "lin_vel_b", "ang_vel_b", "lin_acc_b", "ang_acc_b")
        for name in names:
            self.buffer(name, torch.zeros(num_envs, 3, device=device))
        self.quat_w = self.buffer("quat_w", torch.zeros(num_envs, 4, device=device))


@relation(offset_fits)
class Imu(SensorBase):
    """A sensor of the pose, velocities and accelerations of a frame on a body, like Isaac Lab's ``Imu``.

    Accelerations are finite differences over the last physics step: velocities that events write do not count, and
    after a reset, they are 0 until the next physics step. Measurements with the suffix ``_b`` show a sloping floor, and
    on the root link also the errors of ``randomize_imu_errors``.

    Args:
        body_name: expression of the body.
        offset: pose in the body's frame: ``pos``, m, and ``rot``, (w, x, y, z).
        gravity_bias: added to the acceleration, world axes, m/s^2; by default minus gravity, as an IMU at rest reads.
        accelerometer: errors of ``lin_acc_b``; null means none.
        gyroscope: errors of ``ang_vel_b``; null means none.
    """

    data: ImuData

    def __init__(
        self,
        body_name: str,
        offset: Offset | None = None,
        gravity_bias: Annotated[Sequence[float], Length(3)] = (0.0, 0.0, 9.81),
        accelerometer: Annotated[ImuNoise, Targeted()] | None = None,
        gyroscope: Annotated[ImuNoise, Targeted()] | None = None,
        update_period: NonNegative = 0.0,
    ) -> None:
        super().__init__(update_period)
        for name, errors in (("accelerometer", accelerometer), ("gyroscope", gyroscope)):
            if not isinstance(errors, ImuNoise | None):
                raise ConfigError("is not an ImuNoise", key=name, expected="a _target_ of ImuNoise")
        self._body, self._offset, self._bias = body_name, offset, gravity_bias
        self._errors = (accelerometer or ImuNoise(), gyroscope or ImuNoise())

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        super().add_to(spec, name, robot)
        self._mount, self._robot = Mount(self._body, robot, f"{self.key}.body_name"), robot
        self.body_names = [self._mount.body]

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        super().connect(sim, stream)
        n, device = sim.num_envs, sim.device
        self._offset_pos, self._offset_quat = offset_pose(self._offset, device)
        self._turn = rotation.quat_to_matrix(self._offset_quat.unsqueeze(0))[0]
        gravity = torch.tensor(sim.model.opt.gravity.tolist(), device=device)
        self._gravity = torch.nn.functional.normalize(gravity, dim=0)
        self._gravity_bias = torch.tensor([float(part) for part in self._bias], device=device)
        self._weight = self._gravity_bias.norm()
        self.data = self.child("data", ImuData(n, device))
        self._before = self.buffer("_before", torch.zeros(n, 6, device=device))
        self._acc = self.buffer("_acc", torch.zeros(n, 6, device=device))
        spread = [[e.std, *e.bias_range, e.bias_walk] for e in self._errors for _ in range(3)]
        self._std, self._low, self._high, self._walk = torch.tensor(spread, device=device).unbind(dim=1)
        self._bias_b = self.buffer("_bias_b", torch.zeros(n, 6, device=device))
        self._noise_b = self.buffer("_noise_b", torch.zeros(n, 6, device=device))
        self._stream = stream() if any(map(any, spread)) else None

    @property
    def offset_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Position (3,), m, and orientation (w, x, y, z), (4,), of the IMU in the body's frame."""
        return self._offset_pos, self._offset_quat

    def update(self) -> None:
        now = self._velocities()
        self._acc = (now - self._before) / self._dt
        self._before = now
        super().update()

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:
        if self._stream is not None:
            white, step = torch.randn(2, *self._bias_b.shape, generator=self._stream, device=self._sim.device).unbind()
            since = torch.as_tensor(elapsed, device=self._sim.device).reshape(-1, 1)
            self._noise_b = self._std * white
            walked = self._bias_b + self._walk * since.sqrt() * step
            self._bias_b = walked if due is None else torch.where(due.unsqueeze(1), walked, self._bias_b)
        self._show(due)

    def reset(self, env_ids: torch.Tensor) -> None:
        fill_rows(self._elapsed, env_ids, 0.0)
        fill_rows(self._is_new, env_ids, True)
        if self._stream is not None:
            count, device = len(env_ids), self._sim.device
            self._bias_b[env_ids] = rotation.uniform(self._low, self._high, count, self._stream)
            self._noise_b[env_ids] = self._std * torch.randn(count, 6, generator=self._stream, device=device)

    def refresh(self, env_ids: torch.Tensor) -> None:
        written = torch.zeros_like(self._is_new).index_fill(0, env_ids, True)
        self._before = torch.where(written.unsqueeze(1), self._velocities(), self._before)
        self._acc = torch.where((written & self._is_new).unsqueeze(1), 0.0, self._acc)
        self._show(written if self.update_period == 0.0 else written & self._is_new)
        fill_rows(self._is_new, env_ids, False)

    def _velocities(self) -> torch.Tensor:
        """Return the IMU's linear and angular velocity in world axes, (N, 6)."""
        ang, arm = self._mount.ang_vel_w, self._mount.rot_w @ self._offset_pos
        return torch.cat((self._mount.lin_vel_w + torch.linalg.cross(ang, arm), ang), dim=1)

    def _show(self, due: torch.Tensor | None) -> None:
        """Write new measurements to ``data`` in the environments of the mask ``due``; None means all environments."""
        body = self._mount.rot_w
        robot = self._robot.data
        has_errors = robot.has_imu_errors and self._mount.index == 0
        rot = (body @ robot.imu_tilt if has_errors else body) @ self._turn
        velocity, acceleration = self._before.split(3, dim=1), self._acc.split(3, dim=1)
        gravity = robot.gravity_dir_w
        felt = acceleration[0] + self._gravity_bias - self._weight * (gravity - self._gravity)
        vectors = torch.stack((*velocity, felt, acceleration[1], gravity), dim=1)
        lin_vel, ang_vel, lin_acc, ang_acc, gravity = (vectors @ rot).unbind(dim=1)
        error = self._bias_b + self._noise_b
        seen = {"projected_gravity_b": gravity, "lin_vel_b": lin_vel, "ang_acc_b": ang_acc}
        seen |= {"ang_vel_b": ang_vel + error[:, 3:], "lin_acc_b": lin_acc + error[:, :3]}
        if has_errors:
            seen["ang_vel_b"] = seen["ang_vel_b"] + robot.gyro_bias
        seen["pos_w"] = self._mount.pos_w + body @ self._offset_pos
        seen["quat_w"] = rotation.quat_mul(self._mount.quat_w, self._offset_quat.expand(len(body), 4))
        for name, value in seen.items():
            last = getattr(self.data, name)
            last.copy_(value if due is None else torch.where(due.unsqueeze(1), value, last))
