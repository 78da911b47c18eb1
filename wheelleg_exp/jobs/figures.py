"""Figures of a rollout: who survived, how high and how upright the robot stood, what its links carried."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.sim.contact import ContactSensor


@dataclass(frozen=True)
class StandFigures:
    """How a policy stood, over the first episode of each environment.

    Attributes:
        episodes: number of episodes.
        unfinished: episodes that had not ended when the rollout did.
        survival: share that reached the time-out.
        height_rmse_m: root mean square of base height minus target, after the settling time; None without target.
        height_mean_m: mean base height after the settling time.
        pitch_rms_deg: root mean square of the pitch after the settling time, against upright.
        pitch_mean_deg: mean pitch after the settling time: the lean.
        mean_return: mean of the episodes' reward.
        ended_by: number of episodes ended by each termination.
    """

    episodes: int
    unfinished: int
    survival: float
    height_rmse_m: float | None
    height_mean_m: float
    pitch_rms_deg: float
    pitch_mean_deg: float
    mean_return: float
    ended_by: dict[str, int]

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return asdict(self)


class StandMeter:
    """Observes an environment over the first episode of each of its N environments.

    Args:
        env: the environment.
        settle_s: seconds at the start of each episode that height and pitch leave out.
    """

    def __init__(self, env: ManagerBasedRLEnv, settle_s: float) -> None:
        self._env = env
        self._settle_steps = settle_s / env.step_dt
        self._target = target_height(env)
        self.running = torch.ones(env.num_envs, dtype=torch.bool)
        self._survived = torch.zeros(env.num_envs, dtype=torch.bool)
        self._return = torch.zeros(env.num_envs)
        self._ended = {name: 0 for name in env.termination_manager.active_terms}
        self._heights: list[torch.Tensor] = []
        self._pitches: list[torch.Tensor] = []

    def observe(self) -> None:
        """Take up one step, before anything is reset."""
        env, now = self._env, self.running
        self._return += env.reward_buf * now
        settled = now & (env.episode_length_buf > self._settle_steps)
        data = env.scene.robot.data
        self._heights.append(data.root_pos_w[settled, 2])
        self._pitches.append(torch.asin(data.projected_gravity_b[settled, 0].clamp(-1.0, 1.0)))
        done = env.termination_manager.dones & now
        self._survived |= done & env.termination_manager.time_outs & ~env.termination_manager.terminated
        for name in self._ended:
            self._ended[name] += int((done & env.termination_manager.get_fired(name)).sum())
        self.running = now & ~done

    def figures(self) -> StandFigures:
        """Return the figures of the episodes so far."""
        heights, pitches = torch.cat(self._heights), torch.rad2deg(torch.cat(self._pitches))
        error = None if self._target is None else heights - self._target
        return StandFigures(
            episodes=self._env.num_envs,
            unfinished=int(self.running.sum()),
            survival=float(self._survived.float().mean()),
            height_rmse_m=None if error is None else _rms(error),
            height_mean_m=float(heights.mean()) if len(heights) else float("nan"),
            pitch_rms_deg=_rms(pitches),
            pitch_mean_deg=float(pitches.mean()) if len(pitches) else float("nan"),
            mean_return=float(self._return.mean()),
            ended_by=dict(self._ended),
        )


@dataclass(frozen=True)
class ContactFigures:
    """What one link carried: normal force over the steps between landing and tipping over.

    Attributes:
        body: the link.
        mean_n: mean force, N.
        max_n: largest force, N.
        contact_share: share of the steps with contact.
    """

    body: str
    mean_n: float
    max_n: float
    contact_share: float


class ContactMeter:
    """Sums the contact forces of each link while its robot stands.

    A robot stands from ``settle_s`` after its reset on, as long as it is tilted by less than ``upright_rad``.

    Args:
        env: the environment.
        sensor: name of the contact sensor.
        settle_s: seconds after a reset until the robot has landed.
        upright_rad: tilt from which on it is falling, rad.
    """

    def __init__(self, env: ManagerBasedRLEnv, sensor: str, settle_s: float, upright_rad: float) -> None:
        self._env = env
        self._sensor: ContactSensor = env.scene[sensor]
        self._settle_s, self._upright = settle_s, upright_rad
        bodies = len(self._sensor.body_names)
        self._sum, self._max, self._touching = torch.zeros(bodies), torch.zeros(bodies), torch.zeros(bodies)
        self._count = 0

    def observe(self) -> None:
        """Take up one step, before anything is reset."""
        env = self._env
        tilt = torch.acos((-env.scene.robot.data.projected_gravity_b[:, 2]).clamp(-1.0, 1.0))
        standing = (env.episode_length_buf * env.step_dt >= self._settle_s) & (tilt < self._upright)
        force = torch.linalg.vector_norm(self._sensor.net_forces_w[standing], dim=-1)
        if len(force):
            self._sum += force.sum(dim=0)
            self._max = torch.maximum(self._max, force.amax(dim=0))
            self._touching += (force > 0).sum(dim=0)
            self._count += len(force)

    def figures(self) -> list[ContactFigures]:
        """Return what each link carried, in the sensor's order; empty when no robot stood."""
        count = self._count
        if count == 0:
            return []
        rows = zip(self._sensor.body_names, self._sum, self._max, self._touching, strict=True)
        return [ContactFigures(b, float(s) / count, float(m), float(t) / count) for b, s, m, t in rows]


def target_height(env: ManagerBasedRLEnv) -> float | None:
    """Return the base height that the task rewards, or None where no reward names one."""
    for name in env.reward_manager.active_terms:
        target = env.reward_manager.get_term(name).params.get("target_height")
        if target is not None:
            return float(target)
    return None


def _rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt()) if len(values) else float("nan")
