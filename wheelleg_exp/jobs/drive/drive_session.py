"""Simulate one robot under a policy with the commands and requests of a user, and compute metrics of the motion."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict

from wheelleg_exp.definitions import ending
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation.disturbance_tests import add_velocity
from wheelleg_exp.jobs.drive.drive_script import Axis, CommandHold, Controls, DriveLog, Jump, Push, Reset, RobotRequest
from wheelleg_exp.managers.non_finite import require_finite_actions
from wheelleg_exp.mdp.commands import JumpCommand, UniformVelocityTravelCommand
from wheelleg_exp.mdp.commands.command_ranges import RangedCommand
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.sim.scene import RobotState

# Each function in ``_MEASURES`` returns the measured value of a command component, such as the forward speed.
_MEASURES: dict[str, Callable[[Any], torch.Tensor]] = {
    "lin_vel_x": lambda data: data.root_lin_vel_b[:, 0],
    "lin_vel_y": lambda data: data.root_lin_vel_b[:, 1],
    "ang_vel_z": lambda data: data.root_ang_vel_b[:, 2],
    "pitch": lambda data: torch.asin(data.projected_gravity_b[:, 0].clamp(-1.0, 1.0)),
    "roll": lambda data: torch.atan2(-data.projected_gravity_b[:, 1], -data.projected_gravity_b[:, 2]),
}


class DriveMeter:
    """Computes the metrics of a robot that a user drives, step by step; ``definitions.drive`` defines each metric."""

    def __init__(self, env: ManagerBasedRLEnv, axes: Sequence[Axis]) -> None:
        self._env, self._axes = env, list(axes)
        self._steps, self._distance = 0, 0.0
        self._squares: defaultdict[str, float] = defaultdict(float)
        self._reward = self._height = 0.0
        self.height_m, self.measured = self._look()
        self._ended: Counter[str] = Counter()
        self._requests: Counter[str] = Counter()
        self._place: torch.Tensor | None = None

    @property
    def falls(self) -> int:
        """The number of episodes that a termination term has ended."""
        return sum(self._ended.values())

    def observe(self, commanded: Mapping[str, float]) -> None:
        """Update driving metrics, such as the distance; ``commanded`` are the commands of the last control step."""
        place = self._env.scene.robot.data.root_pos_w[0, :2].clone()
        if self._place is not None:
            self._distance += float(torch.linalg.vector_norm(place - self._place))
        self._place = place
        self._steps += 1
        self._reward += float(self._env.reward_buf[0])
        self.height_m, self.measured = self._look()
        self._height += self.height_m
        for name, value in self.measured.items():
            self._squares[name] += (value - commanded[name]) ** 2

    def ended(self, by: str) -> None:
        """Count an episode that was ended by the termination term ``by``."""
        self._ended[by] += 1

    def asked(self, request: RobotRequest) -> None:
        """Count a request."""
        self._requests[type(request).__name__] += 1

    def began(self) -> None:
        """Record a reset, so that the robot's jump to its start position does not count as travelled distance."""
        self._place = None

    def figures(self) -> dict[str, object]:
        """Return the metrics of the driven robot as values that JSON can store."""
        count = max(self._steps, 1)
        return {
            "duration_s": self._steps * self._env.step_dt,
            "steps": self._steps,
            "distance_m": self._distance,
            "falls": dict(self._ended),
            "resets": self._requests[Reset.__name__],
            "pushes": self._requests[Push.__name__],
            "jumps": self._requests[Jump.__name__],
            "height_mean_m": self._height / count,
            "reward": self._reward,
            "tracking_rmse": {name: (total / count) ** 0.5 for name, total in self._squares.items()},
        }

    def _look(self) -> tuple[float, dict[str, float]]:
        """Return the robot's height (m) and the measured value of each command component, such as the speed."""
        scene, measured = self._env.scene, {}
        position = scene.robot.data.root_pos_w
        height = float((position[:, 2] - scene.terrain.height_at(position[:, :2]))[0])
        for axis in self._axes:
            if axis.component == "height":
                measured[axis.name] = height
            elif axis.component in _MEASURES:
                measured[axis.name] = float(_MEASURES[axis.component](scene.robot.data)[0])
        return height, measured


@dataclass(frozen=True)
class Status:
    """The state of a driven robot and its episode at one moment, as Python numbers."""

    time_s: float  # the simulated time since the user started to drive, s
    commands: dict[str, float]
    measured: dict[str, float]
    height_m: float
    rewards: dict[str, float] = field(default_factory=dict)  # the weighted reward per second of each reward term
    falls: int = 0
    fallen: str | None = None  # how the episode ended, or None while the episode runs


class DriveSession:
    """A simulated robot that a user drives. After an episode ends, the simulation waits for a call of ``reset``.

    ``start`` is the initial state; None for a reset. ``fallen`` describes how the episode ended; None while it runs.
    """

    def __init__(
        self, adapter: RslRlVecEnv, policy: Callable[[TensorDict], torch.Tensor], start: RobotState | None = None
    ) -> None:
        if adapter.num_envs != 1:
            raise ConfigError(f"a user can drive one robot, not {adapter.num_envs}", key="env.num_envs", expected="1")
        self._adapter, self._policy = adapter, policy
        self.env: ManagerBasedRLEnv = adapter.env
        self.env.autoreset = "disabled"
        manager = self.env.command_manager
        terms = {name: manager.get_term(name) for name in manager.active_terms}
        # The axes of the commands, in the order of the terms, without axes of empty range.
        ranged = ((name, term.ranges) for name, term in terms.items() if isinstance(term, RangedCommand))
        pairs = ((name, part, pair) for name, parts in ranged for part, pair in parts.items())
        found = [(name, part, float(pair[0]), float(pair[1])) for name, part, pair in pairs if pair[0] < pair[1]]
        times = Counter(part for _, part, *_ in found)
        self.axes = [
            Axis(f"{t}.{part}" if times[part] > 1 else part, t, part, low, high) for t, part, low, high in found
        ]
        self.controls = Controls(self.axes)
        self._hold = CommandHold(self.env, self.axes)
        self.driven = DriveLog(self.env.step_dt)
        self.meter = DriveMeter(self.env, self.axes)
        self.steps = 0
        self.fallen: str | None = None
        self.jumps = [term for term in terms.values() if isinstance(term, JumpCommand)]
        # A jump after a bump needs a velocity command that measures how far the wheels roll.
        measuring = {name for name, term in terms.items() if isinstance(term, UniformVelocityTravelCommand)}
        self._bump_jumps = [term for term in self.jumps if term.velocity_command in measuring]
        for term in self.jumps:
            term.share = 0.0  # The user starts the jumps.
        for term in self._bump_jumps:
            self.controls.trigger = term.trigger
        self._hold(self.controls.values)
        if start is None:
            self.env.reset()
        else:
            self.env.reset_to(start)

    @property
    def time_s(self) -> float:
        """The simulated time since the user started to drive the robot, s."""
        return self.steps * float(self.env.step_dt)

    def step(self) -> None:
        """Simulate one control step with the user's current commands."""
        values, trigger = self.controls.values, self.controls.trigger
        self.driven.commanded(self.steps, values | ({} if trigger is None else {"trigger": trigger}))
        self._hold(values)
        for term in self._bump_jumps:
            if trigger not in (None, term.trigger):
                term.select_trigger(trigger)
                self.env.settings_may_have_changed()
        actions = self._policy(self._adapter.get_observations())
        require_finite_actions(self.env, actions)
        self._adapter.step(actions)
        self.steps += 1
        self.meter.observe(values)
        if bool(self.env.termination_manager.dones[0]):
            terms = self.env.termination_manager.get_active_iterable_terms(0)
            self.fallen = ending(name for name, (flag,) in terms if flag)
            self.meter.ended(self.fallen)

    def obey(self, request: RobotRequest) -> None:
        """Carry out a request of the user. After the robot has fallen, only ``Reset`` has an effect."""
        if self.fallen is not None:
            if isinstance(request, Reset):
                self.reset()
            return
        if isinstance(request, Jump) and not self.jumps:
            return
        self.driven.asked(self.steps, request)
        self.meter.asked(request)
        if isinstance(request, Push):
            add_velocity(self.env, torch.tensor([[request.x, request.y]], device=self.env.device))
        elif isinstance(request, Jump):
            for term in self.jumps:
                term.start(torch.ones_like(term.is_jumping_env))
        else:
            self.reset()

    def reset(self) -> None:
        """Start a new episode with the user's current commands."""
        self._hold(self.controls.values)
        self.env.reset()
        self.meter.began()
        self.fallen = None

    def status(self) -> Status:
        """Return the state of the driven robot."""
        rewards = self.env.reward_manager
        return Status(
            time_s=self.time_s,
            commands=self.controls.values,
            measured=self.meter.measured,
            height_m=self.meter.height_m,
            rewards={n: v for n, (v,) in rewards.get_active_iterable_terms(0) if rewards.get_term_cfg(n).weight},
            falls=self.meter.falls,
            fallen=self.fallen,
        )
