"""How hard a push a standing robot survives, by bisection, and how soon it stands again after one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from wheelleg_exp.evaluation.measuring.standing import Columns
from wheelleg_exp.evaluation.options import Push
from wheelleg_exp.evaluation.over_time import Trajectories, largest, last_exit, mean
from wheelleg_exp.evaluation.rollout import Policy, Rollout, Tell


@dataclass
class Pushes:
    """Changes the velocity of the whole robot at one moment, or evenly over a pulse, in its own level axes.

    Args:
        rollout: the rollout whose episodes are pushed.
        options: when, how long, in which directions.
    """

    rollout: Rollout
    options: Push

    def __post_init__(self) -> None:
        env, options = self.rollout.env, self.options
        cell = self.rollout.scenarios.cell_of().to(env.device)
        turn = (cell % options.directions).float() * (2.0 * math.pi / options.directions)
        self.direction = torch.stack((turn.cos(), turn.sin()), dim=1)
        steps = [max(1, round(pulse / env.step_dt)) for pulse in options.pulses_s]
        self.pulse = torch.tensor(steps, device=env.device)[cell // options.directions]
        self.begin = round(options.at_s / env.step_dt)
        self._longest = max(steps)

    def of(self, change: torch.Tensor) -> Callable[[int], None]:
        """Return what pushes with changes of velocity, m/s, (N,), called before each step with its number."""
        env = self.rollout.env
        each = self.direction * (change / self.pulse).unsqueeze(1)

        def push(step: int) -> None:
            done = step - self.begin
            if not 0 <= done < self._longest:
                return
            data = env.scene.robot.data
            cos, sin = data.heading_w.cos(), data.heading_w.sin()
            x, y = (each * (done < self.pulse).unsqueeze(1)).unbind(dim=1)
            velocity = torch.cat((data.root_lin_vel_w, data.root_ang_vel_w), dim=1)
            velocity[:, 0] += cos * x - sin * y
            velocity[:, 1] += sin * x + cos * y
            env.scene.robot.write_root_velocity_to_sim(velocity)
            env.scene.refresh()

        return push


def push_columns(
    rollout: Rollout, policy: Policy, options: Push, seed: int, target: float | None, tell: Tell | None
) -> tuple[Columns, Trajectories]:
    """Return what pushes each episode survives and how it recovers from the reference push; (N,) each.

    ``limit_m_s`` is found by halving [0, highest]: every episode is rolled ``iterations`` times from the same start,
    with the middle of what is left of its interval; 0 where it survived none. ``limit_normalised`` divides it by
    √(g h), h the height before the push. ``recovery_s`` is the time after the reference push from which on tilt and
    height stay in their bands, at least for ``recovered_s``; NaN where they never left them, because there is nothing
    to recover from. ``recovered`` is 1 where the bands hold from ``within_s`` on at the latest and the episode lived,
    else 0.
    """
    pushes, n = Pushes(rollout, options), rollout.scenarios.size
    low = torch.zeros(n, device=rollout.env.device)
    high = torch.full_like(low, float(options.highest))
    rolls = options.iterations + 1
    for iteration in range(options.iterations):
        middle = (low + high) / 2
        made = rollout.roll(policy, seed, _part(tell, iteration, rolls), pushes.of(middle))
        low, high = torch.where(made.fell, low, middle), torch.where(made.fell, middle, high)
    reference = torch.full_like(low, float(options.reference))
    made = rollout.roll(policy, seed, _part(tell, options.iterations, rolls), pushes.of(reference))
    limit = torch.where(low > 0, (low + high) / 2, 0.0).double()
    before = made.counted(0.0, options.at_s)
    height = mean(made.height, before) if target is None else torch.full_like(limit, target)
    columns = {"limit_m_s": limit, "limit_normalised": limit / (rollout.parts.gravity * height).sqrt()}
    return columns | recovery(made, options, height), made


def recovery(made: Trajectories, options: Push, height: torch.Tensor) -> Columns:
    """Return how the episodes came back from a push (see ``push_columns``).

    Args:
        made: the episodes.
        options: when the push was, and what counts as recovered.
        height: that the base should have, m, (N,).
    """
    after = made.counted(options.at_s)
    tilt = torch.acos((made.roll.cos() * made.pitch.cos()).clamp(-1.0, 1.0))
    outside = (tilt >= options.recovered_tilt) | ((made.height - height).abs() >= options.recovered_height)
    time = last_exit(outside, after, made.dt)
    latest = min(options.within_s, options.after_s - options.recovered_s)
    return {
        "recovery_s": torch.where(made.fell | ~(outside & after).any(dim=0), torch.nan, time),
        "recovered": (~made.fell & (time <= latest)).double(),
        "push_tilt_rad": largest(tilt, after),
    }


def _part(tell: Tell | None, part: int, parts: int) -> Tell | None:
    """Return what tells a part of several rollouts as one."""
    if tell is None:
        return None
    return lambda done, of: tell(part * of + done, parts * of)
