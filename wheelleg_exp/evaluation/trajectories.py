"""Trajectories of a rollout as tensors over time, and means over the steps that count.

``EffortMeter`` sums torque and mechanical power over the physics steps of each control step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch

from wheelleg_exp.managers import Env
from wheelleg_exp.sim.rotation import wrap_to_pi
from wheelleg_exp.sim.sensors import SensorBase

if TYPE_CHECKING:
    from wheelleg_exp.env import ManagerBasedRLEnv
    from wheelleg_exp.evaluation.evaluation_env import RobotParts


class EffortMeter(SensorBase):
    """Sum torques and work over every physics step, so that chatter within a control step counts.

    The meter is updated like a sensor, but is not part of the model. Power is torque times the mean of the speeds
    before and after the step. The net power leaves out I_a q̈, the torque that only accelerates the armature; its work
    is exactly the armature's gain of kinetic energy.

    Args:
        env: the environment; the meter joins its scene.
        saturation: share of the effort limit from which an actuator counts as saturated.
        deadband: share of the effort limit up to which a torque has no sign.
        dt: the physics step, s.

    Attributes:
        gross: ∑|τ q̇| Δt since ``begin``, J, (N,).
        net: the same of τ - I_a q̈, J, (N,).
        positive: ∑max(τ q̇, 0) Δt, J, (N,).
        peak: largest sum over the joints of max(τ q̇, 0), W, (N,).
        saturated: number of physics steps at the effort limit, (N, J).
        squares: ∑τ² over the physics steps, (N·m)², (N, J).
        sign_changes: how often τ crossed the whole dead band, (N, J).
    """

    def __init__(self, env: Env, saturation: float, deadband: float, dt: float) -> None:
        super().__init__()
        self.name, self.body_names, self._dt = "evaluation_effort", [], dt
        self._data, self._share, self._deadband = env.scene.robot.data, saturation, deadband
        n, joints = self._data.joint_vel.shape
        self._sums = torch.zeros(4, n, device=env.device)
        self.gross, self.net, self.positive, self.peak = self._sums.unbind()
        self._of_joints = torch.zeros(4, n, joints, device=env.device)
        self.saturated, self.squares, self.sign_changes, self._sign = self._of_joints.unbind()
        self._steps = torch.zeros((), device=env.device)  # a tensor, so that replays of a CUDA graph count, too
        self._armature = self._data.joint_armature
        env.scene.sensors[self.name] = self

    def start(self) -> None:
        """Start a rollout with the armatures of this reset."""
        self._armature = self._data.joint_armature

    def begin(self, counted: torch.Tensor | bool) -> None:
        """Start a control step.

        Args:
            counted: whether the previous control step counts, for all or (N,). A sign change after a step that does not
                count is not counted.
        """
        self._sums.zero_()
        self._of_joints[:3].zero_()
        # A zero sign makes the next product zero, so the first counted step has no sign change.
        self._sign *= counted if isinstance(counted, bool) else counted.unsqueeze(1)
        self._steps.zero_()

    def update(self) -> None:
        """Add the physics step that has just run."""
        data = self._data
        torque, before, after = data.applied_torque, data.joint_vel_before, data.joint_vel
        speed = (before + after) / 2
        power = torque * speed
        driven = power.clamp(min=0.0).sum(dim=1)
        net = (torque * self._dt - self._armature * (after - before)) * speed
        self.gross += power.abs().sum(dim=1) * self._dt
        self.net += net.abs().sum(dim=1)
        self.positive += driven * self._dt
        torch.maximum(self.peak, driven, out=self.peak)
        limits, size = data.joint_effort_limits, torque.abs()
        self.saturated += size >= self._share * limits
        self.squares += torque.square()
        has_sign = size > torch.nan_to_num(self._deadband * limits, posinf=0.0)  # false for a NaN torque
        sign = torch.where(has_sign, torque.sign(), self._sign)
        self.sign_changes += sign * self._sign < 0.0
        self._sign.copy_(sign)
        self._steps += 1

    def shares(self) -> torch.Tensor:
        """Return the share of the control step's physics steps at the effort limit, (N, J)."""
        return self.saturated / self._steps.clamp(min=1)

    def torque_rms(self) -> torch.Tensor:
        """Return the RMS torque over the control step's physics steps, N·m, (N, J)."""
        return (self.squares / self._steps.clamp(min=1)).sqrt()

    def reset(self, env_ids: torch.Tensor) -> None:
        """Do nothing: the sums restart with each control step."""


@dataclass
class Trajectories:
    """T control steps of N episodes. Values after the end of an episode are undefined.

    Attributes:
        dt: the control step, s.
        alive: whether the episode still runs after the step, (T, N) bool.
        pos: position of the root link from the environment's origin, m, (T, N, 3).
        height: height of the root link over the ground below it, m, (T, N).
        roll: roll of the base, rad, (T, N).
        pitch: pitch of the base, rad, (T, N).
        yaw: yaw of the base, rad, in -pi to pi, (T, N).
        vel: velocity of the base's centre of mass in its own axes, m/s, (T, N, 3), which velocity commands refer to.
        ang: angular velocity of the base in its own axes, rad/s, (T, N, 3).
        command: command during the step, (T, N, 3).
        action: action of the policy, (T, N, A).
        joint_pos: rad, (T, N, J).
        joint_vel: rad/s, (T, N, J).
        torque: torque in the last physics step, N·m, (T, N, J).
        torque_rms: RMS torque over the physics steps of the control step, N·m, (T, N, J).
        sign_changes: sign changes of each wheel's torque during the step, (T, N, W).
        down: whether each wheel was on the ground, (T, N, W) bool.
        work: gross, net, and positive mechanical work of the step, J, and the peak of the positive power, W, (T, N, 4).
        saturated: share of the step at the effort limit, (T, N, J).
        fell_at: number of the step in which each episode failed, from 1; 0 without a failure, (N,) long.
        ended_by: index of the cause, (N,) long; -1 without a failure.
    """

    dt: float
    alive: torch.Tensor
    pos: torch.Tensor
    height: torch.Tensor
    roll: torch.Tensor
    pitch: torch.Tensor
    yaw: torch.Tensor
    vel: torch.Tensor
    ang: torch.Tensor
    command: torch.Tensor
    action: torch.Tensor
    joint_pos: torch.Tensor
    joint_vel: torch.Tensor
    torque: torch.Tensor
    torque_rms: torch.Tensor
    sign_changes: torch.Tensor
    down: torch.Tensor
    work: torch.Tensor
    saturated: torch.Tensor
    fell_at: torch.Tensor
    ended_by: torch.Tensor

    @classmethod
    def empty(cls, steps: int, n: int, parts: RobotParts, actions: int, env: ManagerBasedRLEnv) -> Self:
        """Return buffers for T steps of N episodes, none of them alive."""
        joints, wheels = len(parts.joint_names), len(parts.wheels)

        def room(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(steps, n, *shape, dtype=dtype, device=env.device)

        def row(value: int) -> torch.Tensor:
            return torch.full((n,), value, dtype=torch.long, device=env.device)

        return cls(
            dt=env.step_dt,
            alive=room(dtype=torch.bool),
            **{name: room() for name in ("height", "roll", "pitch", "yaw")},
            **{name: room(3) for name in ("pos", "vel", "ang", "command")},
            **{name: room(joints) for name in ("joint_pos", "joint_vel", "torque", "torque_rms", "saturated")},
            action=room(actions),
            sign_changes=room(wheels),
            down=room(wheels, dtype=torch.bool),
            work=room(4),
            fell_at=row(0),
            ended_by=row(-1),
        )

    def take(
        self,
        step: int,
        env: ManagerBasedRLEnv,
        parts: RobotParts,
        meter: EffortMeter,
        command: torch.Tensor,
        action: torch.Tensor,
        alive: torch.Tensor,
        force: float,
    ) -> None:
        """Store one step of the environment."""
        data = env.scene.robot.data
        pos, gravity = data.root_pos_w, data.projected_gravity_b
        self.alive[step], self.command[step], self.action[step] = alive, command, action
        self.pos[step] = pos - env.scene.env_origins
        self.height[step] = pos[:, 2] - env.scene.terrain.height_at(pos[:, :2])
        self.roll[step] = torch.atan2(-gravity[:, 1], -gravity[:, 2])
        self.pitch[step] = torch.asin(gravity[:, 0].clamp(-1.0, 1.0))
        self.yaw[step] = data.heading_w
        self.vel[step], self.ang[step] = data.root_lin_vel_b, data.root_ang_vel_b
        self.joint_pos[step], self.joint_vel[step] = data.joint_pos, data.joint_vel
        self.torque[step], self.torque_rms[step] = data.applied_torque, meter.torque_rms()
        self.sign_changes[step] = meter.sign_changes[:, parts.wheels]
        forces = env.scene[parts.contacts].data.net_forces_w[:, parts.wheel_bodies]
        self.down[step] = torch.linalg.vector_norm(forces, dim=-1) > force
        self.work[step] = torch.stack((meter.gross, meter.net, meter.positive, meter.peak), dim=1)
        self.saturated[step] = meter.shares()

    def end(self, step: int, failed: torch.Tensor, why: torch.Tensor) -> None:
        """Store the failures of a step. Only the first failure of each episode counts."""
        first = failed & (self.fell_at == 0)
        self.ended_by = torch.where(first, why, self.ended_by)
        self.fell_at = torch.where(first, step + 1, self.fell_at)

    @property
    def steps(self) -> int:
        """Number of control steps, T."""
        return len(self.alive)

    @property
    def fell(self) -> torch.Tensor:
        """Whether each episode failed, (N,) bool."""
        return self.fell_at > 0

    def counted(self, begin_s: float, end_s: float | None = None) -> torch.Tensor:
        """Return the mask of counted steps: of running episodes, after ``begin_s`` up to ``end_s``, (T, N)."""
        moments = torch.arange(1, self.steps + 1, device=self.alive.device)
        window = moments > round(begin_s / self.dt)
        if end_s is not None:
            window &= moments <= round(end_s / self.dt)
        return self.alive & window.unsqueeze(1)

    def unwrapped_yaw(self) -> torch.Tensor:
        """Return the yaw without jumps, rad, (T, N)."""
        turns = wrap_to_pi(self.yaw.diff(dim=0)).cumsum(dim=0)
        return self.yaw[:1] + torch.cat((torch.zeros_like(self.yaw[:1]), turns))


def mean(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the mean of (T, N, ...) over counted steps and trailing axes, (N,); NaN without steps."""
    # In float64, because float32 loses digits in sums over long episodes.
    flat = values.double().flatten(2).mean(dim=2) if values.dim() > 2 else values.double()
    steps = counted.sum(dim=0)
    total = torch.where(counted, flat, 0.0).sum(dim=0)
    return torch.where(steps > 0, total / steps, torch.nan)


def rms(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the root mean square of (T, N, ...) over counted steps and trailing axes, (N,); NaN without steps."""
    return mean(values.double().square(), counted).sqrt()


def largest(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the largest value of (T, N) over counted steps, (N,); NaN without steps."""
    found = torch.where(counted, values.double(), -torch.inf).amax(dim=0)
    return torch.where(counted.any(dim=0), found, torch.nan)


def total(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the sum of (T, N) over counted steps, (N,); NaN without steps."""
    found = torch.where(counted, values.double(), 0.0).sum(dim=0)
    return torch.where(counted.any(dim=0), found, torch.nan)


def slope(values: torch.Tensor, counted: torch.Tensor, dt: float) -> torch.Tensor:
    """Return the least-squares slope of (T, N) over time, per second, (N,); NaN with fewer than two steps."""
    time = torch.arange(len(values), dtype=torch.float64, device=values.device).unsqueeze(1) * dt
    weight, y = counted.double(), torch.where(counted, values.double(), 0.0)
    steps = weight.sum(dim=0).clamp(min=1)
    centred = (time - (weight * time).sum(dim=0) / steps) * weight
    found = (centred * y).sum(dim=0) / centred.square().sum(dim=0)
    return torch.where(counted.sum(dim=0) >= 2, found, torch.nan)


def at(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return (T, N, ...) at the last step before the counted steps, (N, ...)."""
    first = (counted.int().argmax(dim=0) - 1).clamp(min=0)
    return values[first, torch.arange(values.shape[1], device=values.device)]


def last_exit(outside: torch.Tensor, counted: torch.Tensor, dt: float) -> torch.Tensor:
    """Return the time from the first counted step to the last step outside, s, (N,); NaN if the end is outside."""
    begin = counted.int().argmax(dim=0)
    steps = torch.arange(1, len(outside) + 1, device=outside.device).unsqueeze(1)
    last = torch.where(counted & outside, steps, 0).amax(dim=0)
    end = torch.where(counted, steps, 0).amax(dim=0)
    after = ((last - begin) * dt).clamp(min=0.0)
    return torch.where(counted.any(dim=0) & (last < end), after.double(), torch.nan)
