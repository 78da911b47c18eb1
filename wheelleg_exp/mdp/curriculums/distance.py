"""Harder ground for robots that come as far as they are told to."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Count, NonNegative, Share
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.sim.ids import fill_rows

_ROBOT = SceneEntityCfg("robot")


class terrain_levels_by_distance(TermBase):
    """Send each robot to harder or easier tiles by the way that it came along its commands; returns the levels.

    Of the episode that ends, the way along the commands (the velocity in level axes that turn with the robot, on the
    command's direction, summed up) is divided by the way that was commanded. An episode that ends by a failure counts
    as if what was commanded until then had been commanded to the end of a longest one. Up goes who reaches ``up``,
    down who does not get beyond ``down``; who was not told to go ``min_distance`` stays, but for those that failed,
    who go down. Whoever passes the hardest row goes on in a random one. On ground without tiles nothing moves.
    ``stuck`` is 1 when the mean level has not risen for ``patience`` longest episodes and is below the
    hardest row's half; training warns.

    Args:
        env: the environment.
        command_name: the command, whose first two components are a planar velocity, m/s.
        up: share of the commanded way from which on a robot goes up.
        down: share up to which it goes down.
        min_distance: m, fewest that an episode must have commanded.
        patience: longest episodes without a rise.
        asset_cfg: the robot.
    """

    def __init__(
        self,
        env: Env,
        command_name: str = "base_velocity",
        up: Share = 0.7,
        down: Share = 0.35,
        min_distance: NonNegative = 0.2,
        patience: Count = 20,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        if down >= up:
            raise ConfigError(f"is {down:g}", key="down", expected=f"less than up, {up:g}")
        env.command_manager.get_term(command_name)
        self._env, self._command, self._asset = env, command_name, asset_cfg.name
        self._up, self._down, self._least, self._patience = up, down, min_distance, patience
        self._commanded = torch.zeros(env.num_envs, device=env.device)
        self._covered = torch.zeros(env.num_envs, device=env.device)
        self._best, self._best_at = -1.0, 0
        env.observers.append(self.observe)

    def observe(self) -> None:
        """Add this step to the present episodes."""
        data = self._env.scene[self._asset].data
        command = self._env.command_manager.get_command(self._command)[:, :2]
        speed = torch.linalg.vector_norm(command, dim=1)
        cos, sin = torch.cos(data.heading_w), torch.sin(data.heading_w)
        velocity = data.root_lin_vel_w
        forwards = cos * velocity[:, 0] + sin * velocity[:, 1]
        sideways = cos * velocity[:, 1] - sin * velocity[:, 0]
        along = (command[:, 0] * forwards + command[:, 1] * sideways) / speed.clamp(min=1e-9)
        self._commanded += speed * self._env.step_dt
        self._covered += torch.where(speed > 0.0, along, 0.0) * self._env.step_dt

    def __call__(self, env: Env, env_ids: torch.Tensor) -> dict[str, float | torch.Tensor]:
        """Move the robots whose episodes end."""
        terrain = env.scene.terrain
        length = env.episode_length_buf[env_ids]
        lived = length > 0
        failed = env.termination_manager.terminated[env_ids] & lived
        rest = torch.where(failed, env.max_episode_length / length.clamp(min=1), 1.0)
        commanded, covered = self._commanded[env_ids] * rest, self._covered[env_ids]
        told = commanded >= self._least
        up = lived & told & (covered >= self._up * commanded)
        down = lived & torch.where(told, covered <= self._down * commanded, failed)
        terrain.update_env_origins(env_ids, up, down)
        fill_rows(self._commanded, env_ids, 0.0)
        fill_rows(self._covered, env_ids, 0.0)
        levels = terrain.terrain_levels.float()
        mean = float(levels.mean())
        if mean > self._best:
            self._best, self._best_at = mean, env.common_step_counter
        waited = env.common_step_counter - self._best_at > self._patience * env.max_episode_length
        low = mean < 0.5 * (terrain.max_terrain_level - 1)
        return {"mean": mean, "highest": levels.max(), "stuck": float(waited and low)}
