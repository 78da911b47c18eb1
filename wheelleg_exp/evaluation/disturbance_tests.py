"""Tests with disturbances: pushes and changed worlds.

The push test finds by bisection the hardest push that a standing robot survives, and measures the recovery time after a
push of a fixed strength. The robustness test changes one property of the simulation at a time, such as friction.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from wheelleg_exp.evaluation.motion_columns import Columns
from wheelleg_exp.evaluation.policy_rollout import Policy, Rollout, Tell
from wheelleg_exp.evaluation.protocol_options import Push, Robust
from wheelleg_exp.evaluation.trajectories import Trajectories, largest, last_exit, mean


@dataclass
class Pushes:
    """Pushes robots: changes their velocities in a yaw-aligned frame, in one step or evenly over several steps."""

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
        """Return a callback ``push(step)``; its calls together change each robot's velocity by ``change`` (N,), m/s."""
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
    """Return each episode's hardest survived push, and its recovery from a push of ``reference`` m/s, (N,) each.

    ``limit_m_s`` is the hardest survived push, found by bisection between 0 and ``highest`` m/s in ``iterations``
    simulations from the same start. ``limit_m_s`` is 0 if the robot falls after every push. ``limit_normalised`` is
    ``limit_m_s`` divided by √(g h), where h is the height of the base before the push. ``recovery_s`` is the time from
    the push of ``reference`` m/s until tilt and height stay in their tolerance bands. ``recovery_s`` is NaN if the
    robot falls, or if tilt and height never leave their bands. ``recovered`` is 1 if the robot does not fall and its
    tilt and height stay in their bands from ``within_s`` on, else 0.
    """
    pushes, n = Pushes(rollout, options), rollout.scenarios.size
    low = torch.zeros(n, device=rollout.env.device)
    high = torch.full_like(low, float(options.highest))
    rolls = options.iterations + 1
    for iteration in range(options.iterations):
        middle = (low + high) / 2
        made = rollout.roll(policy, seed, _part(tell, iteration, rolls), pushes.of(middle))
        # The hardest survived push is between ``low`` and ``high``: a fall lowers ``high``, survival raises ``low``.
        low, high = torch.where(made.fell, low, middle), torch.where(made.fell, middle, high)
    reference = torch.full_like(low, float(options.reference))
    made = rollout.roll(policy, seed, _part(tell, options.iterations, rolls), pushes.of(reference))
    limit = torch.where(low > 0, (low + high) / 2, 0.0).double()
    before = made.counted(0.0, options.at_s)
    height = mean(made.height, before) if target is None else torch.full_like(limit, target)
    columns = {"limit_m_s": limit, "limit_normalised": limit / (rollout.parts.gravity * height).sqrt()}
    return columns | recovery(made, options, height), made


def recovery(made: Trajectories, options: Push, height: torch.Tensor) -> Columns:
    """Return ``recovery_s`` and ``recovered`` of each episode, given the target height of the base, m, (N,)."""
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
    """Return a callback that converts the progress of one rollout to the progress of the whole test."""
    return None if tell is None else lambda done, of: tell(part * of + done, parts * of)


@dataclass(frozen=True)
class World:
    """A variant of the simulation in the robustness test, with its own config section ``env``."""

    sweep: str
    value: float
    cfg: dict[str, Any] = field(repr=False)
    delay_steps: int = 0


def worlds(cfg: Mapping[str, Any], options: Robust, base: str, step_dt: float) -> Iterator[World]:
    """Yield the unchanged simulation (``nominal``) and all variants of the simulation for the robustness test.

    ``worlds`` adds events that set masses, centres of mass, gains, or friction after the task's own events. ``worlds``
    gives observation terms Gaussian noise, whose standard deviation is a factor times ``noise_std``. ``base`` is the
    name of the robot's root link.
    """
    yield World("nominal", 0.0, copy.deepcopy(dict(cfg)))
    for value in options.friction:
        friction = {"static_friction_range": [value, value], "dynamic_friction_range": [value, value]}
        more = {"restitution_range": [0.0, 0.0], "num_buckets": 1}
        changed = _with_event(cfg, "randomize_rigid_body_material", {"body_names": [".*"]}, **friction, **more)
        changed["scene"]["terrain"] |= {"static_friction": value, "dynamic_friction": value}
        yield World("friction", value, changed)
    for value in options.mass:
        mass = {"mass_distribution_params": [value, value], "operation": "scale"}
        yield World("mass", value, _with_event(cfg, "randomize_rigid_body_mass", {"body_names": [".*"]}, **mass))
    for value in options.com:
        shift = {"x": [value, value], "y": [0.0, 0.0], "z": [0.0, 0.0]}
        changed = _with_event(cfg, "randomize_rigid_body_com", {"body_names": [base]}, com_range=shift)
        yield World("com", value, changed)
    for value in options.gains:
        gains = {f"{name}_distribution_params": [value, value] for name in ("stiffness", "damping")}
        changed = _with_event(cfg, "randomize_actuator_gains", {"joint_names": [".*"]}, operation="scale", **gains)
        yield World("gains", value, changed)
    for value in options.noise:
        changed = copy.deepcopy(dict(cfg))
        for group in changed["observations"].values():
            corrupts, group["enable_corruption"] = bool(group.get("enable_corruption", False)), True
            for node in group["terms"].values():
                name = str(node["_target_"]).rpartition(".")[2]
                if name in options.noise_std:
                    std = value * options.noise_std[name]
                    node["noise"] = {"_target_": "wheelleg_exp.mdp.noise.GaussianNoise", "mean": 0.0, "std": std}
                elif not corrupts:
                    node["noise"] = None
        yield World("noise", value, changed)
    for value in options.delay_s:
        yield World("delay", value, copy.deepcopy(dict(cfg)), round(value / step_dt))


def _with_event(cfg: Mapping[str, Any], function: str, on: Mapping[str, Any], **parameters: Any) -> dict[str, Any]:
    changed = copy.deepcopy(dict(cfg))
    asset = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", **on}
    node = {"_target_": f"wheelleg_exp.mdp.events.{function}", "mode": "startup", "asset_cfg": asset, **parameters}
    changed["events"] = {**changed["events"], f"evaluation_{function}": node}
    return changed


class DelayedPolicy:
    """A policy with actions that are delayed by a whole number of control steps. The first actions are zeros."""

    def __init__(self, policy: Policy, steps: int) -> None:
        self._policy, self._steps = policy, steps
        self._waiting: list[torch.Tensor] = []

    def reset(self) -> None:
        """Discard all delayed actions and reset the policy."""
        self._waiting = []
        if hasattr(self._policy, "reset"):
            self._policy.reset()

    def __call__(self, observations: Mapping[str, Any]) -> torch.Tensor:
        """Return the actions that the policy returned ``steps`` calls ago."""
        actions = self._policy(observations)
        self._waiting.append(actions)
        return self._waiting.pop(0) if len(self._waiting) > self._steps else torch.zeros_like(actions)
