"""Store the trajectories of a rollout as tensors over time, and compute means over masked steps."""

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
    """Sums joint torques and work over all physics steps, so that metrics include chatter within a control step.

    It is updated like a sensor, but is not in the MuJoCo model. Power is a joint's torque times the mean of its speeds
    before and after the physics step; the net power excludes the torque I_a q̈, whose work only changes the armature's
    kinetic energy. ``gross``, ``net``, and ``positive`` (N,) are the mechanical work of a control step, J; ``peak``
    (N,) is the largest positive power of all joints together, W.

    For each joint (N, J), ``saturated`` counts physics steps (of ``dt`` s) with a torque of at least ``saturation``
    times the effort limit, ``squares`` sums squared torques, and ``sign_changes`` counts the torque's changes of sign,
    without torques of at most ``deadband`` times the effort limit.
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
        # Count physics steps in a tensor, so that each replay of a CUDA graph increases the count.
        self._steps = torch.zeros((), device=env.device)
        self._armature = self._data.joint_armature
        env.scene.sensors[self.name] = self

    def start(self) -> None:
        """Start a rollout: read the armatures of the joints, which a reset can randomise."""
        self._armature = self._data.joint_armature

    def begin(self, counted: torch.Tensor | bool) -> None:
        """Start a control step. ``counted``, one bool or (N,), says whether metrics use the previous control step.

        If ``counted`` is false, ignore a change of the torque's sign between the previous and this control step.
        """
        self._sums.zero_()
        self._of_joints[:3].zero_()
        self._sign *= counted if isinstance(counted, bool) else counted.unsqueeze(1)
        self._steps.zero_()

    def update(self) -> None:
        """Add the torques and the work of the last physics step to the sums over the control step."""
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
        has_sign = size > torch.nan_to_num(self._deadband * limits, posinf=0.0)  # False for NaN
        sign = torch.where(has_sign, torque.sign(), self._sign)
        self.sign_changes += sign * self._sign < 0.0
        self._sign.copy_(sign)
        self._steps += 1

    def shares(self) -> torch.Tensor:
        """Return the share of a control step's physics steps in which each joint was at its effort limit, (N, J)."""
        return self.saturated / self._steps.clamp(min=1)

    def torque_rms(self) -> torch.Tensor:
        """Return the RMS torque of each joint over the physics steps of a control step, N·m, (N, J)."""
        return (self.squares / self._steps.clamp(min=1)).sqrt()

    def reset(self, env_ids: torch.Tensor) -> None:
        """Do nothing, because the sums of torques and work restart at each control step, not at a reset."""

    def refresh(self, env_ids: torch.Tensor) -> None:
        """Do nothing, because only physics steps change the sums of torques and work."""


@dataclass
class Trajectories:
    """The motion of N episodes over T control steps, in SI units and radians.

    ``pos`` (relative to the environment's origin) and ``height`` (over the ground) are those of the root link. ``vel``,
    of the base's centre of mass, and ``ang`` are in the base's axes. ``torque`` is that of the last physics step in
    each control step; ``torque_rms``, ``sign_changes``, and ``saturated`` (share of steps at the effort limit) use all.
    ``clearance`` is the height of each wheel's lowest point over the ground. ``work`` contains gross, net, and positive
    work, and the largest positive power. ``fell_at`` is the number, from 1, of the control step in which an episode
    failed, and ``ended_by`` the index of the cause. Values after the end of an episode are undefined.
    """

    dt: float  # s
    alive: torch.Tensor  # (T, N) bool
    pos: torch.Tensor  # (T, N, 3)
    height: torch.Tensor  # (T, N)
    roll: torch.Tensor  # (T, N)
    pitch: torch.Tensor  # (T, N)
    yaw: torch.Tensor  # (T, N), ±π
    vel: torch.Tensor  # (T, N, 3)
    ang: torch.Tensor  # (T, N, 3)
    command: torch.Tensor  # (T, N, 3)
    action: torch.Tensor  # (T, N, A)
    joint_pos: torch.Tensor  # (T, N, J)
    joint_vel: torch.Tensor  # (T, N, J)
    torque: torch.Tensor  # (T, N, J)
    torque_rms: torch.Tensor  # (T, N, J)
    sign_changes: torch.Tensor  # (T, N, W)
    down: torch.Tensor  # (T, N, W) bool
    clearance: torch.Tensor  # (T, N, W)
    work: torch.Tensor  # (T, N, 4)
    saturated: torch.Tensor  # (T, N, J)
    fell_at: torch.Tensor  # (N,), 0 without failure
    ended_by: torch.Tensor  # (N,), -1 without failure

    @classmethod
    def empty(cls, steps: int, n: int, parts: RobotParts, actions: int, env: ManagerBasedRLEnv) -> Self:
        """Return empty buffers for T steps of N episodes."""
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
            clearance=room(wheels),
            work=room(4),
            fell_at=row(0),
            ended_by=row(-1),
        )

    @property
    def steps(self) -> int:
        """Number of control steps, T."""
        return len(self.alive)

    @property
    def fell(self) -> torch.Tensor:
        """A mask of the episodes that ended with a failure, (N,) bool."""
        return self.fell_at > 0

    def counted(self, begin_s: float, end_s: float | None = None) -> torch.Tensor:
        """Return the mask of counted steps: of running episodes, after ``begin_s`` up to ``end_s``, (T, N)."""
        moments = torch.arange(1, self.steps + 1, device=self.alive.device)
        window = moments > round(begin_s / self.dt)
        if end_s is not None:
            window &= moments <= round(end_s / self.dt)
        return self.alive & window.unsqueeze(1)

    def unwrapped_yaw(self) -> torch.Tensor:
        """Return the yaw of each robot over time without jumps of 2π, rad, (T, N)."""
        turns = wrap_to_pi(self.yaw.diff(dim=0)).cumsum(dim=0)
        return self.yaw[:1] + torch.cat((torch.zeros_like(self.yaw[:1]), turns))


def mean(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Average ``values`` (T, N, ...) over trailing axes and steps in the mask ``counted``, (N,); NaN without steps."""
    # Sum in float64, because a float32 sum over a long episode loses precision.
    flat = values.double().flatten(2).mean(dim=2) if values.dim() > 2 else values.double()
    return total(flat, counted) / counted.sum(dim=0)


def rms(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the RMS of ``values`` (T, N, ...) over trailing axes and over the steps in the mask ``counted``, (N,)."""
    return mean(values.double().square(), counted).sqrt()


def largest(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the largest of ``values`` (T, N) over the steps in the mask ``counted``, (N,); NaN without steps."""
    found = torch.where(counted, values.double(), -torch.inf).amax(dim=0)
    return torch.where(counted.any(dim=0), found, torch.nan)


def total(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the sum of ``values`` (T, N) over the steps in the mask ``counted``, (N,); NaN without steps."""
    found = torch.where(counted, values.double(), 0.0).sum(dim=0)
    return torch.where(counted.any(dim=0), found, torch.nan)


def slope(values: torch.Tensor, counted: torch.Tensor, dt: float) -> torch.Tensor:
    """Return the least-squares slope of ``values`` (T, N) over time, 1/s, (N,); NaN with fewer than two steps."""
    time = torch.arange(len(values), dtype=torch.float64, device=values.device).unsqueeze(1) * dt
    weight, y = counted.double(), torch.where(counted, values.double(), 0.0)
    steps = weight.sum(dim=0).clamp(min=1)
    centred = (time - (weight * time).sum(dim=0) / steps) * weight
    found = (centred * y).sum(dim=0) / centred.square().sum(dim=0)
    return torch.where(counted.sum(dim=0) >= 2, found, torch.nan)


def at(values: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return each episode's entry of ``values`` (T, N, ...) at the step before ``counted`` becomes true, (N, ...)."""
    return values[(counted.int().argmax(dim=0) - 1).clamp(min=0), torch.arange(values.shape[1], device=values.device)]


def last_exit(outside: torch.Tensor, counted: torch.Tensor, dt: float) -> torch.Tensor:
    """Return the settling time, s, (N,): from the start of ``counted`` until ``outside`` stays false, or NaN."""
    begin = counted.int().argmax(dim=0)
    steps = torch.arange(1, len(outside) + 1, device=outside.device).unsqueeze(1)
    last = torch.where(counted & outside, steps, 0).amax(dim=0)
    end = torch.where(counted, steps, 0).amax(dim=0)
    after = ((last - begin) * dt).clamp(min=0.0)
    return torch.where(counted.any(dim=0) & (last < end), after.double(), torch.nan)
