"""Figures of a rollout: survival, base height and pitch, contact forces, drift, smoothness, and motor load.

Meters read an environment's state after every control step, before the reset; ``definitions.rollout`` defines metrics.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.evaluation.trajectories import EffortMeter
from wheelleg_exp.sim.rotation import wrap_to_pi
from wheelleg_exp.sim.sensors.contact_sensor import ContactSensor


@dataclass(frozen=True)
class StandFigures:
    """Metrics of how a robot stands in the first episode of each environment; ``definitions.rollout`` defines them."""

    episodes: int
    unfinished: int
    survival: float | None  # the share of all ended episodes that reached the time-out
    settle_s: float  # Height and pitch are not measured in the first ``settle_s`` seconds of an episode.
    settled_episodes: int
    settled_steps: int
    height_rmse_m: float | None
    height_mean_m: float
    pitch_rms_deg: float  # against upright
    pitch_mean_deg: float
    mean_return: float | None
    ended_by: dict[str, int]  # maps each termination term (or combination of terms) to its number of ended episodes
    non_finite: dict[str, int] = field(default_factory=dict)

    @property
    def ended(self) -> int:
        """The number of environments in which the first episode has ended."""
        return self.episodes - self.unfinished

    def as_dict(self) -> dict[str, object]:
        """Return the rollout's metrics as a dictionary of numbers."""
        found = asdict(self)
        return found if self.non_finite else {key: value for key, value in found.items() if key != "non_finite"}


class StandMeter:
    """Measures survival, height, and pitch in the first episode of each environment."""

    def __init__(self, env: ManagerBasedRLEnv, settle_s: float) -> None:
        self._env = env
        self._settle_s, self._settle_steps = settle_s, settle_s / env.step_dt
        rewards = env.reward_manager
        targets = [rewards.get_term_cfg(name).params.get("target_height") for name in rewards.active_terms]
        self._target = next((float(target) for target in targets if target is not None), None)
        self.running = torch.ones(env.num_envs, dtype=torch.bool)
        self._survived = torch.zeros(env.num_envs, dtype=torch.bool)
        self._settled = torch.zeros(env.num_envs, dtype=torch.bool)
        self._return = torch.zeros(env.num_envs)
        self._ended = Counter({name: 0 for name in env.termination_manager.active_terms})
        self._failed = torch.zeros(env.num_envs, dtype=torch.bool)
        self._non_finite: Counter[str] = Counter()
        self._heights: list[torch.Tensor] = []
        self._pitches: list[torch.Tensor] = []

    def observe(self) -> None:
        """Update the statistics of height, pitch, and reward once per control step, before environments are reset."""
        env, now = self._env, self.running
        for env_id, keys in env.extras.get("non_finite", {"keys": {}})["keys"].items():
            if now[env_id]:
                self._failed[env_id] = True
                self._non_finite.update(keys)
        self._return += env.reward_buf * now
        settled = now & ~self._failed & (env.episode_length_buf > self._settle_steps)
        self._settled |= settled
        data = env.scene.robot.data
        self._heights.append(data.root_pos_w[settled, 2])
        self._pitches.append(torch.asin(data.projected_gravity_b[settled, 0].clamp(-1.0, 1.0)))
        done = env.termination_manager.dones & now
        self._survived |= done & env.termination_manager.time_outs & ~env.termination_manager.terminated
        self._ended.update(env.termination_manager.endings(done))
        self.running = now & ~done

    def figures(self) -> StandFigures:
        """Return the metrics of the environments' first episodes."""
        heights, pitches = torch.cat(self._heights), torch.rad2deg(torch.cat(self._pitches))
        error = None if self._target is None else heights - self._target
        ended = ~self.running
        whole = ended & ~self._failed
        return StandFigures(
            episodes=self._env.num_envs,
            unfinished=int(self.running.sum()),
            survival=float(self._survived[ended].float().mean()) if ended.any() else None,
            settle_s=self._settle_s,
            settled_episodes=int(self._settled.sum()),
            settled_steps=len(heights),
            height_rmse_m=None if error is None else _rms(error),
            height_mean_m=float(heights.mean()) if len(heights) else float("nan"),
            pitch_rms_deg=_rms(pitches),
            pitch_mean_deg=float(pitches.mean()) if len(pitches) else float("nan"),
            mean_return=float(self._return[whole].mean()) if whole.any() else None,
            ended_by=dict(self._ended),
            non_finite=dict(self._non_finite),
        )


@dataclass(frozen=True)
class ContactFigures:
    """Contact forces of one link, N: the normal force at the end of each step between landing and tipping over."""

    body: str
    mean_n: float
    max_n: float
    contact_share: float  # the share of control steps (of standing robots) in which the link ``body`` has contact
    steps: int  # the number of control steps with a standing robot, summed over all environments


class ContactMeter:
    """Collects contact forces while a robot stands: ``settle_s`` s after a reset until a tilt of ``upright_rad``."""

    def __init__(self, env: ManagerBasedRLEnv, sensor: str, settle_s: float, upright_rad: float) -> None:
        self._env = env
        self._sensor: ContactSensor = env.scene[sensor]
        self._settle_s, self._upright = settle_s, upright_rad
        bodies = len(self._sensor.body_names)
        self._sum, self._max, self._touching = torch.zeros(bodies), torch.zeros(bodies), torch.zeros(bodies)
        self._count = 0

    def observe(self) -> None:
        """Update the statistics of the contact forces once per control step, before environments are reset."""
        env = self._env
        tilt = torch.acos((-env.scene.robot.data.projected_gravity_b[:, 2]).clamp(-1.0, 1.0))
        standing = (env.episode_length_buf * env.step_dt >= self._settle_s) & (tilt < self._upright)
        force = torch.linalg.vector_norm(self._sensor.data.net_forces_w[standing], dim=-1)
        if len(force):
            self._sum += force.sum(dim=0)
            self._max = torch.maximum(self._max, force.amax(dim=0))
            self._touching += (force > 0).sum(dim=0)
            self._count += len(force)

    def figures(self) -> list[ContactFigures]:
        """Return contact force statistics of each link of the sensor, or an empty list if no robot ever stood."""
        count = self._count
        if count == 0:
            return []
        rows = zip(self._sensor.body_names, self._sum, self._max, self._touching, strict=True)
        return [ContactFigures(b, float(s) / count, float(m), float(t) / count, count) for b, s, m, t in rows]


def _rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt()) if len(values) else float("nan")


SATURATION = 0.99  # A motor torque of at least 99 % of its effort limit counts as saturated.
DEADBAND = 0.001  # ``sign_changes_per_s`` ignores torques of at most 0.1 % of the motor's effort limit.


@dataclass(frozen=True)
class MotionFigures:
    """Metrics of how a robot moves in the first episode of each environment; ``definitions.rollout`` defines them."""

    drift_m: float | None
    yaw_drift_deg: float | None
    action_rate_per_s: float | None
    power_net_w: float | None
    torque_rms_nm: dict[str, float]  # by actuator group
    at_limit: dict[str, float]  # maps each actuator group to its share of physics steps with saturated torque
    sign_changes_per_s: dict[str, float]  # by actuator group


class MotionMeter:
    """Measures motion in each environment's first episode, without the first ``settle_s`` seconds."""

    def __init__(self, env: ManagerBasedRLEnv, settle_s: float) -> None:
        self._env, self._settle_steps = env, settle_s / env.step_dt
        self._effort = EffortMeter(env, SATURATION, DEADBAND, env.physics_dt)
        self._effort.begin(counted=False)
        robot, device, n = env.scene.robot, env.device, env.num_envs
        self._groups = {name: actuator.joint_ids for name, actuator in robot.actuators.items()}
        joints = robot.data.joint_pos.shape[1]

        def row(*shape: int) -> torch.Tensor:
            return torch.zeros(n, *shape, dtype=torch.float64, device=device)

        self._running = torch.ones(n, dtype=torch.bool, device=device)
        self._settled, self._before = torch.zeros_like(self._running), torch.zeros_like(self._running)
        self._place, self._heading, self._turned = row(2), row(), row()
        self._drift, self._yaw = row(), row()
        self._steps, self._pairs, self._changed, self._work = row(), row(), row(), row()
        self._squares, self._limit, self._flips = (row(joints) for _ in range(3))

    def observe(self) -> None:
        """Update the statistics of drift, actions, and torques once per control step, before environments are reset."""
        env, data = self._env, self._env.scene.robot.data
        numbers = torch.isfinite(data.root_pos_w).all(dim=1) & torch.isfinite(data.applied_torque).all(dim=1)
        now = self._running & numbers & (env.episode_length_buf > self._settle_steps)
        place, heading = data.root_pos_w[:, :2].double(), data.heading_w.double()
        first = now & ~self._settled
        self._place = torch.where(first.unsqueeze(1), place, self._place)
        self._turned = torch.where(first, 0.0, self._turned + wrap_to_pi(heading - self._heading))
        self._heading = heading
        away = torch.linalg.vector_norm(place - self._place, dim=1)
        self._drift = torch.where(now, torch.maximum(self._drift, away), self._drift)
        self._yaw = torch.where(now, torch.maximum(self._yaw, self._turned.abs()), self._yaw)
        mask = now.unsqueeze(1)
        self._squares += torch.where(mask, self._effort.torque_rms().double().square(), 0.0)
        self._limit += torch.where(mask, self._effort.shares().double(), 0.0)
        self._flips += torch.where(mask, self._effort.sign_changes.double(), 0.0)
        self._work += torch.where(now, self._effort.net.double(), 0.0)
        both = now & self._before
        action = env.action_manager
        self._changed += torch.where(both, (action.action - action.prev_action).abs().mean(dim=1), 0.0)
        self._pairs += both
        self._steps += now
        self._before, self._settled = now, self._settled | now
        self._running = self._running & ~env.termination_manager.dones
        self._effort.begin(now)

    def figures(self) -> MotionFigures:
        """Return the metrics of the environments' first episodes."""
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
