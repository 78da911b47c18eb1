"""Event terms that disturb the robot: wrenches and pushes."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import torch

from wheelleg_exp.constraints import Interval, NonNegativeInterval, PositiveInterval
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase, bounds
from wheelleg_exp.mdp.events.randomization import POSE, PoseRange, all_ids
from wheelleg_exp.sim import rotation

_ROBOT = SceneEntityCfg("robot")


def set_permanent_body_wrench(
    env: Env,
    env_ids: torch.Tensor | None,
    force_range: Interval,
    torque_range: Interval,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Draw a force (N) and a torque (N·m), in link axes, that act on each body's centre of mass until the next reset.

    Each range applies to all three axes. Isaac Lab's name is ``apply_external_force_torque``.
    """
    ids = all_ids(env, env_ids)
    robot = env.scene.articulations[asset_cfg.name]
    bodies = asset_cfg.body_list(len(robot.body_names))
    low, high = _wrench_bounds(*force_range, *torque_range, env.device)
    drawn = rotation.uniform(low, high, ids.shape[0] * len(bodies), generator)
    robot.set_permanent_wrench(ids, bodies, drawn.view(ids.shape[0], len(bodies), 6))


@cache
def _wrench_bounds(
    least_force: float, largest_force: float, least_torque: float, largest_torque: float, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    low, high = [least_force] * 3 + [least_torque] * 3, [largest_force] * 3 + [largest_torque] * 3
    return torch.tensor(low, device=device), torch.tensor(high, device=device)


apply_external_force_torque = set_permanent_body_wrench


class push_by_adding_velocity(TermBase):
    """Add a uniform random velocity to the velocity of the root's centre of mass, in the axes of ``frame``.

    Isaac Lab: ``push_by_setting_velocity``.

    Args:
        velocity_range: ``x``, ``y``, ``z`` in m/s, and ``roll``, ``pitch``, ``yaw`` in rad/s.
        frame: ``world``, as in Isaac Lab; or ``yaw``, level axes that turn with the robot: x forwards, y to the left.
        curriculum_name: a curriculum term with a level for each robot, which multiplies the added velocity.
    """

    adds = True

    def __init__(
        self,
        env: Env,
        velocity_range: PoseRange,
        generator: torch.Generator,
        asset_cfg: SceneEntityCfg = _ROBOT,
        frame: Literal["world", "yaw"] = "world",
        curriculum_name: str | None = None,
    ) -> None:
        self._curriculum = curriculum_name
        self._low, self._high = bounds(velocity_range, POSE, "velocity_range", env.device)
        self._generator = generator
        self._robot = env.scene.articulations[asset_cfg.name]
        self._turns = frame == "yaw"

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids = all_ids(env, env_ids)
        velocity = rotation.uniform(self._low, self._high, ids.shape[0], self._generator)
        if self._curriculum is not None:
            curriculum: Any = env.curriculum_manager.get_term_cfg(self._curriculum).func
            velocity *= curriculum.level[ids].unsqueeze(1)
        data = self._robot.data
        if self._turns:
            yaw = data.heading_w[ids]
            cos, sin = yaw.cos().unsqueeze(1), yaw.sin().unsqueeze(1)
            x, y, z = velocity.view(-1, 2, 3).unbind(dim=2)
            velocity = torch.stack((cos * x - sin * y, sin * x + cos * y, z), dim=2).flatten(1)
        if self.adds:
            velocity += data.root_vel_w[ids]
        self._robot.write_root_velocity_to_sim(velocity, ids)


push_by_setting_velocity = push_by_adding_velocity


class set_root_velocity(push_by_adding_velocity):
    """Set the velocity of the root's centre of mass to a uniform random velocity, in the axes of ``frame``."""

    adds = False


class apply_body_impulse(TermBase):
    """Push bodies at random times with a constant force (N) and torque (N·m), in the event mode ``step``.

    A push acts on centres of mass in link axes, in addition to the wrenches of other events, until a reset at the
    latest. Each range applies to all three axes, with separate draws for each body. Each episode starts with a pause.

    Args:
        force_range: [low, high], N.
        torque_range: [low, high], N·m.
        duration_s: [low, high], duration of a push, s.
        pause_s: [low, high], time from the end of a push, or from a reset, to the next push, s.
        asset_cfg: the robot and its bodies.
    """

    def __init__(
        self,
        env: Env,
        force_range: Interval,
        torque_range: Interval,
        duration_s: PositiveInterval,
        pause_s: NonNegativeInterval,
        generator: torch.Generator,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._robot = env.scene.articulations[asset_cfg.name]
        bodies = self._bodies = asset_cfg.body_list(len(self._robot.body_names))
        axes = [force_range] * 3 * len(bodies) + [torque_range] * 3 * len(bodies)
        ranges = torch.tensor([*map(list, axes), list(duration_s), list(pause_s)], device=env.device)
        self._low, self._high = ranges.T
        self._generator = generator
        self._time_left = self.buffer("_time_left", torch.zeros(env.num_envs, device=env.device))
        is_pushed = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._is_pushed = self.buffer("_is_pushed", is_pushed, fill=False)
        self._push = self.buffer("_push", torch.zeros(env.num_envs, len(bodies), 3, 2, device=env.device), fill=0.0)
        self._robot.add_wrench(self._bodies, self._push)  # CUDA graphs only push bodies that are already registered.
        self.reset(torch.arange(env.num_envs, device=env.device))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Start a pause before the next push in ``env_ids``; the robot's reset has already removed the old push."""
        self.reset_rows(env_ids)
        self._time_left[env_ids] = rotation.uniform(self._low, self._high, len(env_ids), self._generator)[:, -1]

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        """Advance one control step: end expired pushes and pauses, and start the next ones."""
        del env_ids
        self._time_left -= env.step_dt
        due = self._time_left < 1e-6
        drawn = rotation.uniform(self._low, self._high, env.num_envs, self._generator)
        self._is_pushed ^= due
        begins = due & self._is_pushed
        self._time_left = torch.where(due, torch.where(begins, drawn[:, -2], drawn[:, -1]), self._time_left)
        wrench = drawn[:, :-2].view(env.num_envs, 2, len(self._bodies), 3).permute(0, 2, 3, 1)
        push = torch.where(begins.view(-1, 1, 1, 1), wrench, self._push) * self._is_pushed.view(-1, 1, 1, 1)
        self._robot.add_wrench(self._bodies, push - self._push)
        self._push = push
