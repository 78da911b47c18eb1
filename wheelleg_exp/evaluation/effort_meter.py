"""Torque and mechanical power of the joints, summed over the physics steps of each control step."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env
from wheelleg_exp.sim.sensors import SensorBase


class EffortMeter(SensorBase):
    """Sees every physics step, as sensors do, but is no part of the model: chatter within a control step counts.

    Power is torque times the mean of the speeds before and after the step; the net power leaves out what only turns
    the armature, I_a q̈, which is exactly what the armature's kinetic energy gains.

    Args:
        env: the environment; the meter joins its scene.
        saturation: share of the effort limit from which on an actuator is at it.
        deadband: share of the effort limit up to which a torque has no sign.
        dt: the physics step, s.

    Attributes:
        gross: ∑|τ q̇| Δt since ``begin``, J, (N,).
        net: the same of τ - I_a q̈, J, (N,).
        positive: ∑max(τ q̇, 0) Δt, J, (N,).
        peak: largest sum over the joints of max(τ q̇, 0), W, (N,).
        saturated: number of physics steps at the effort limit, (N, J).
        squares: ∑τ² over the physics steps, (N·m)², (N, J).
        sign_changes: how often τ passed from beyond the dead band on one side to beyond it on the other, (N, J).
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
        self._steps = torch.zeros((), device=env.device)  # a tensor, so that a captured step counts too
        self._armature = self._data.joint_armature
        env.scene.sensors[self.name] = self

    def start(self) -> None:
        """Begin a rollout: armatures may have been drawn anew."""
        self._armature = self._data.joint_armature

    def begin(self, counted: torch.Tensor | bool) -> None:
        """Begin a control step.

        Args:
            counted: whether the previous control step counts, for all or (N,): a sign change between a step that does
                not count and one that does is not counted.
        """
        self._sums.zero_()
        self._of_joints[:3].zero_()
        self._sign *= counted if isinstance(counted, bool) else counted.unsqueeze(1)
        self._steps.zero_()

    def update(self) -> None:
        """Take up the physics step that has just run."""
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
        has_sign = size > torch.nan_to_num(self._deadband * limits, posinf=0.0)  # NaN has none
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
        """Do nothing: sums begin with each control step."""
