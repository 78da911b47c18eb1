"""Mechanical power of the joints, summed over the physics steps of each control step."""

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
        dt: the physics step, s.

    Attributes:
        gross: ∑|τ q̇| Δt since ``begin``, J, (N,).
        net: the same of τ - I_a q̈, J, (N,).
        positive: ∑max(τ q̇, 0) Δt, J, (N,).
        peak: largest sum over the joints of max(τ q̇, 0), W, (N,).
        saturated: share of the physics steps at the effort limit, (N, J).
    """

    def __init__(self, env: Env, saturation: float, dt: float) -> None:
        super().__init__()
        self.name, self.body_names, self._dt = "evaluation_effort", [], dt
        self._data, self._share = env.scene.robot.data, saturation
        n, joints = self._data.joint_vel.shape
        self._sums = torch.zeros(4, n, device=env.device)
        self.gross, self.net, self.positive, self.peak = self._sums.unbind()
        self.saturated = torch.zeros(n, joints, device=env.device)
        self._steps = 0
        self._armature = self._data.joint_armature
        env.scene.sensors[self.name] = self

    def start(self) -> None:
        """Begin a rollout: armatures may have been drawn anew."""
        self._armature = self._data.joint_armature

    def begin(self) -> None:
        """Begin a control step."""
        self._sums.zero_()
        self.saturated.zero_()
        self._steps = 0

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
        self.saturated += torque.abs() >= self._share * data.joint_effort_limits
        self._steps += 1

    def shares(self) -> torch.Tensor:
        """Return the share of the control step's physics steps at the effort limit, (N, J)."""
        return self.saturated / max(1, self._steps)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Do nothing: sums begin with each control step."""
