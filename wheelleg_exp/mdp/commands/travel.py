"""Velocity commands that remember how far the robot is from where they would have brought it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import torch

from wheelleg_exp.constraints import Interval, NonNegative, Positive, PositiveInterval, Share
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, member
from wheelleg_exp.mdp.commands.velocity import UniformVelocityCommand, VelocityAxis
from wheelleg_exp.sim.ids import fill_rows

_ROLLS = 0.5  # part of a wheel's axis along the base's y, from which on it rolls forwards or backwards


class UniformVelocityTravelCommand(UniformVelocityCommand):
    """A uniform velocity command that also sums up what the robot has travelled too far or not far enough.

    A policy that sees velocities alone creeps at zero command, by whatever it misjudges of them; one that sees the
    sum of its error can hold its place, as an integral controller does. The sum is of what a robot can measure:
    its wheels' rates, which are its speed where they roll, and the yaw rate of its gyroscope. Not in Isaac Lab.

    A robot on two wheels must roll back before it can drive off, and one that is told to be fast at once falls. With
    ``max_lin_acceleration`` and ``max_ang_acceleration`` the command goes towards what was drawn, from zero at a reset,
    by no more than that; ``asked`` is where it goes.

    Args:
        env: the environment.
        ranges: ``lin_vel_x``, ``lin_vel_y`` (m/s), ``ang_vel_z`` (rad/s), ``heading`` (rad, or null).
        resampling_time_range: shortest and longest time between two draws, s.
        generator: the term's random stream.
        wheel_cfg: joints of the wheels. Which way each has to turn to roll forwards follows from its axis in the
            model, so that the wheels of mirrored halves add up as well.
        wheel_radius: of the wheels, m.
        max_travel_error: up to which travel is summed up, m: what is lost beyond it is not made good.
        max_heading_error: the same for the heading, rad.
        max_lin_acceleration: by which the commanded speed changes at most, m/s²; null lets it jump.
        max_ang_acceleration: the same for the yaw rate, rad/s².
        rel_standing_envs: share of draws that stand still.
        rel_heading_envs: share of draws that follow a heading.
        heading_command: whether headings are drawn at all.
        heading_control_stiffness: k, 1/s.
        asset_name: the member of the scene that is commanded.

    Attributes:
        max_acceleration: by which each component changes at most, m/s², m/s², rad/s²; None lets it jump.
        travel_error: how far the robot has gone too far, m, and turned too far, rad, (N, 2).
        wheel_signs: of each wheel, 1 where positive speed rolls it forwards, -1 where backwards.

    Raises:
        ConfigError: a wheel does not roll along the base's x.
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[VelocityAxis, Interval | None],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        wheel_cfg: SceneEntityCfg,
        wheel_radius: Positive,
        max_travel_error: Positive,
        max_heading_error: Positive,
        max_lin_acceleration: Positive | None = None,
        max_ang_acceleration: Positive | None = None,
        rel_standing_envs: Share = 0.0,
        rel_heading_envs: Share = 1.0,
        heading_command: bool = False,
        heading_control_stiffness: NonNegative = 1.0,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(
            env,
            ranges,
            resampling_time_range,
            generator,
            rel_standing_envs,
            rel_heading_envs,
            heading_command,
            heading_control_stiffness,
            asset_name,
        )
        self._wheels = member(env.scene, wheel_cfg.name, "wheel_cfg.name")
        self._wheel_ids, self._radius = wheel_cfg.joint_ids, wheel_radius
        signs = rolling_signs(env.scene.sim.model, self._wheels, wheel_cfg.joint_ids)
        self.wheel_signs = tuple(signs)
        self._signs = (torch.tensor(signs, device=env.device),)
        self.travel_error = torch.zeros(env.num_envs, 2, device=env.device)
        self._asked = torch.zeros(env.num_envs, 3, device=env.device)
        self.max_acceleration = (max_lin_acceleration, max_lin_acceleration, max_ang_acceleration)
        most = [math.inf if limit is None else limit for limit in self.max_acceleration]
        # Tuples: tensors among the attributes are state.
        self._fastest = (torch.tensor(most, device=env.device) * env.step_dt,)
        self._most = (torch.tensor([max_travel_error, max_heading_error], device=env.device),)

    def compute(self, dt: float) -> torch.Tensor:
        """Add this step's error to the sum, then advance the command."""
        (signs,) = self._signs
        rolled = (self._wheels.data.joint_vel[:, self._wheel_ids] * signs).mean(dim=1) * self._radius
        turned = self.robot.data.root_ang_vel_b[:, 2]
        missed = torch.stack((rolled - self._command[:, 0], turned - self._command[:, 2]), dim=1)
        (most,) = self._most
        self.travel_error.add_(missed * dt).clamp_(-most, most)
        return super().compute(dt)

    @property
    def asked(self) -> torch.Tensor:
        """Where the command goes (N, 3)."""
        return self._asked

    def post_process(self) -> None:
        """Steer and stop as ever, and go towards it."""
        super().post_process()
        (most,) = self._fastest
        self._command.add_((self._asked - self._command).clamp_(-most, most))

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Begin the sum anew as well, and the command at rest."""
        fill_rows(self.travel_error, env_ids, 0.0)
        log = super().finish_episode(env_ids)
        (most,) = self._fastest
        self._command.index_copy_(0, env_ids, self._asked.index_select(0, env_ids).clamp(-most, most))
        return log


def rolling_signs(model: mujoco.MjModel, robot: Any, joint_ids: torch.Tensor | Sequence[int] | slice) -> list[float]:
    """Return for each of a robot's wheels 1 where positive speed rolls it along the base's x, -1 where against it.

    A wheel that turns about an axis a rolls along a x up, which is forwards for the part of a along the base's y.

    Args:
        model: the compiled model.
        robot: the robot, in whose default pose the axes are looked at.
        joint_ids: the wheels, columns of ``robot.joint_names``.

    Raises:
        ConfigError: a wheel rolls sideways, or is no hinge.
    """
    data = mujoco.MjData(model)
    for name, value in zip(robot.joint_names, robot.layout.default_joint_pos.tolist(), strict=True):
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    left = data.xmat[int(robot.body_ids[0])].reshape(3, 3)[:, 1]
    signs = []
    for index in torch.arange(len(robot.joint_names), device=robot.body_ids.device)[joint_ids].tolist():
        joint = model.joint(robot.joint_names[index])
        along = float(data.xaxis[joint.id] @ left) if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE else 0.0
        if abs(along) < _ROLLS:
            raise ConfigError(
                f"joint '{joint.name}' does not roll the robot forwards or backwards",
                key="wheel_cfg.joint_names",
                expected="wheels, hinges whose axis lies along the base's y",
            )
        signs.append(math.copysign(1.0, along))
    return signs


def kept_travel_error(env: Env, command_name: str) -> torch.Tensor:
    """Return the travel error (N, 2), m and rad, of a command that keeps one.

    Raises:
        ConfigError: the command keeps none.
    """
    term = env.command_manager.get_term(command_name)
    if not isinstance(term, UniformVelocityTravelCommand):
        raise ConfigError(
            f"the command '{command_name}' does not sum up its error",
            key="command_name",
            expected="a command of wheelleg_exp.mdp.commands.UniformVelocityTravelCommand",
        )
    return term.travel_error
