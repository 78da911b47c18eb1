"""One robot under one policy, step by step, with the commands and requests that are asked for in between."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from wheelleg_exp.definitions.definition import ending
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.drive.axes import Axis, Hold, axes_of
from wheelleg_exp.jobs.drive.controls import Controls, Push, Reset
from wheelleg_exp.jobs.drive.driven import Driven
from wheelleg_exp.jobs.drive.meter import DriveMeter
from wheelleg_exp.managers.finite import require_finite_actions
from wheelleg_exp.rl.vec_env import RslRlVecEnv


@dataclass(frozen=True)
class Status:
    """How a drive stands, in numbers of the host.

    Attributes:
        time_s: simulated time since the drive began.
        commands: what is commanded, by axis.
        measured: the same of the robot, for the axes that can be measured.
        height_m: height of the root link's origin above the ground below it.
        rewards: this step's weighted values per second, by term.
        falls: how often the robot has fallen.
        fallen: by what the episode has ended; None while it goes on.
    """

    time_s: float
    commands: dict[str, float]
    measured: dict[str, float]
    height_m: float
    rewards: dict[str, float] = field(default_factory=dict)
    falls: int = 0
    fallen: str | None = None


class DriveSession:
    """A drive: nothing is reset unless somebody asks for it, and an episode that is over waits until it is.

    Args:
        adapter: the environment, of one robot.
        policy: returns actions (1, A) for observations.

    Attributes:
        env: the environment.
        axes: what may be commanded.
        controls: what is asked for.
        driven: what was asked for, step by step.
        meter: figures of the drive.
        steps: control steps since the drive began.
        fallen: by what the episode has ended; None while it goes on.

    Raises:
        ConfigError: there are several environments.
    """

    def __init__(self, adapter: RslRlVecEnv, policy: Callable[[Any], torch.Tensor]) -> None:
        if adapter.num_envs != 1:
            raise ConfigError(f"{adapter.num_envs} robots cannot be driven", key="env.num_envs", expected="1")
        self._adapter, self._policy = adapter, policy
        self.env: ManagerBasedRLEnv = adapter.env
        self.env.autoreset = "disabled"
        self.axes: list[Axis] = axes_of(self.env)
        self.controls = Controls(self.axes)
        self._hold = Hold(self.env, self.axes)
        self.driven = Driven(self.env.step_dt)
        self.meter = DriveMeter(self.env, self.axes)
        self.steps = 0
        self.fallen: str | None = None
        self._hold(self.controls.values)
        self.env.reset()

    @property
    def time_s(self) -> float:
        """Simulated time since the drive began, s."""
        return self.steps * self.env.step_dt

    def step(self) -> None:
        """Do one control step under the present commands; an episode that is over is not gone on with.

        Raises:
            SimulationFailure: the policy's actions are not finite.
        """
        values = self.controls.values
        self.driven.commanded(self.steps, values)
        self._hold(values)
        actions = self._policy(self._adapter.get_observations())
        require_finite_actions(self.env, actions)
        self._adapter.step(actions)
        self.steps += 1
        self.meter.observe(values)
        if bool(self.env.termination_manager.dones[0]):
            terms = self.env.termination_manager.get_active_iterable_terms(0)
            self.fallen = ending(name for name, (flag,) in terms if flag)
            self.meter.ended(self.fallen)

    def obey(self, request: Reset | Push) -> None:
        """Do what was asked for; a robot that has fallen can only be reset, which would be done unasked as well."""
        if self.fallen is not None:
            if isinstance(request, Reset):
                self.reset()
            return
        self.driven.asked(self.steps, request)
        self.meter.asked(request)
        if isinstance(request, Push):
            self._push(request)
        else:
            self.reset()

    def reset(self) -> None:
        """Begin a new episode under the present commands."""
        self._hold(self.controls.values)
        self.env.reset()
        self.meter.began()
        self.fallen = None

    def _push(self, push: Push) -> None:
        robot, data = self.env.scene.robot, self.env.scene.robot.data
        yaw = float(data.heading_w[0])
        added = (math.cos(yaw) * push.x - math.sin(yaw) * push.y, math.sin(yaw) * push.x + math.cos(yaw) * push.y, 0.0)
        velocity = data.root_lin_vel_w + data.root_lin_vel_w.new_tensor(added)
        robot.write_root_com_velocity_to_sim(torch.cat((velocity, data.root_ang_vel_w), dim=1))
        self.env.scene.refresh()

    def status(self) -> Status:
        """Return how the drive stands."""
        rewards = self.env.reward_manager.get_active_iterable_terms(0)
        return Status(
            time_s=self.time_s,
            commands=self.controls.values,
            measured=self.meter.measured,
            height_m=self.meter.height_m,
            rewards={name: value for name, (value,) in rewards},
            falls=self.meter.falls,
            fallen=self.fallen,
        )
