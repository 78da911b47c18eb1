"""Figures of a rollout beside posture: how far the robot strayed, how smooth it was, what its motors bore."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.evaluation.effort_meter import EffortMeter
from wheelleg_exp.sim.rotation import wrap_to_pi

SATURATION = 0.99  # share of the effort limit from which on an actuator is at it
DEADBAND = 0.001  # share of the effort limit that a torque must pass for its sign to count


@dataclass(frozen=True)
class MotionFigures:
    """How a policy moved, over the first episode of each environment; see ``definitions.rollout``.

    Attributes:
        drift_m: largest distance in the plane from where the base was once settled, mean over the settled episodes.
        yaw_drift_deg: largest turn of the base from its heading once settled, likewise.
        action_rate_per_s: mean change of an action's component per second.
        power_net_w: mean mechanical power of all joints, sizes summed, without what swings the armature.
        torque_rms_nm: root mean square of the torque, by actuator group.
        at_limit: share of the physics steps at the effort limit, by actuator group.
        sign_changes_per_s: how often a joint's torque changes its sign, by actuator group.
    """

    drift_m: float | None
    yaw_drift_deg: float | None
    action_rate_per_s: float | None
    power_net_w: float | None
    torque_rms_nm: dict[str, float]
    at_limit: dict[str, float]
    sign_changes_per_s: dict[str, float]

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return asdict(self)


class MotionMeter:
    """Observes an environment over the first episode of each of its N environments.

    Args:
        env: the environment.
        settle_s: seconds at the start of each episode that nothing here counts.
    """

    def __init__(self, env: ManagerBasedRLEnv, settle_s: float) -> None:
        self._env, self._settle_steps = env, settle_s / env.step_dt
        self._effort = EffortMeter(env, SATURATION, DEADBAND, env.physics_dt)
        self._effort.begin(counted=False)
        robot, device, n = env.scene.robot, env.device, env.num_envs
        self._groups = {name: actuator.joint_ids for name, actuator in robot.actuators.items()}
        joints = robot.data.joint_pos.shape[1]

        def row(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
            return torch.zeros(n, *shape, dtype=dtype, device=device)

        self._running = torch.ones(n, dtype=torch.bool, device=device)
        self._settled, self._before = torch.zeros_like(self._running), torch.zeros_like(self._running)
        self._place, self._heading, self._turned = row(2), row(), row()
        self._drift, self._yaw = row(), row()
        self._steps, self._pairs, self._changed, self._work = row(), row(), row(), row()
        self._squares, self._limit, self._flips = (row(joints) for _ in range(3))

    def observe(self) -> None:
        """Take up one step, before anything is reset."""
        env, data = self._env, self._env.scene.robot.data
        numbers = torch.isfinite(data.root_pos_w).all(dim=1) & torch.isfinite(data.applied_torque).all(dim=1)
        now = self._running & numbers & (env.episode_length_buf > self._settle_steps)
        self._stray(now)
        self._bear(now)
        both = now & self._before
        action = env.action_manager
        jump = (action.action - action.prev_action).abs().mean(dim=1)
        self._changed += torch.where(both, jump, 0.0)
        self._pairs += both
        self._steps += now
        self._before, self._settled = now, self._settled | now
        self._running = self._running & ~env.termination_manager.dones
        self._effort.begin(now)

    def _stray(self, now: torch.Tensor) -> None:
        data = self._env.scene.robot.data
        place, heading = data.root_pos_w[:, :2].double(), data.heading_w.double()
        first = now & ~self._settled
        self._place = torch.where(first.unsqueeze(1), place, self._place)
        self._turned = torch.where(first, 0.0, self._turned + wrap_to_pi(heading - self._heading))
        self._heading = heading
        away = torch.linalg.vector_norm(place - self._place, dim=1)
        self._drift = torch.where(now, torch.maximum(self._drift, away), self._drift)
        self._yaw = torch.where(now, torch.maximum(self._yaw, self._turned.abs()), self._yaw)

    def _bear(self, now: torch.Tensor) -> None:
        mask = now.unsqueeze(1)
        self._squares += torch.where(mask, self._effort.torque_rms().double().square(), 0.0)
        self._limit += torch.where(mask, self._effort.shares().double(), 0.0)
        self._flips += torch.where(mask, self._effort.sign_changes.double(), 0.0)
        self._work += torch.where(now, self._effort.net.double(), 0.0)

    def figures(self) -> MotionFigures:
        """Return the figures of the episodes so far."""
        dt, steps, pairs = self._env.step_dt, float(self._steps.sum()), float(self._pairs.sum())
        none = {} if steps == 0.0 else self._groups

        def share(total: torch.Tensor, ids: torch.Tensor) -> float:
            return float(total[:, ids].sum()) / (steps * max(1, total[:, ids].shape[1]))

        return MotionFigures(
            drift_m=float(self._drift[self._settled].mean()) if steps else None,
            yaw_drift_deg=float(torch.rad2deg(self._yaw[self._settled].mean())) if steps else None,
            action_rate_per_s=float(self._changed.sum()) / (pairs * dt) if pairs else None,
            power_net_w=float(self._work.sum()) / (steps * dt) if steps else None,
            torque_rms_nm={name: share(self._squares, ids) ** 0.5 for name, ids in none.items()},
            at_limit={name: share(self._limit, ids) for name, ids in none.items()},
            sign_changes_per_s={name: share(self._flips, ids) / dt for name, ids in none.items()},
        )
