"""Terms written for Isaac Lab, with changed import lines."""

from __future__ import annotations

from dataclasses import MISSING
from typing import TYPE_CHECKING

import torch

import wheelleg_exp.isaaclab.envs.mdp as mdp
import wheelleg_exp.isaaclab.utils.math as math_utils
from wheelleg_exp.isaaclab.assets import Articulation, RigidObject
from wheelleg_exp.isaaclab.envs.mdp import reset_root_state_uniform  # noqa: F401
from wheelleg_exp.isaaclab.managers import (
    ActionTerm,
    ActionTermCfg,
    CommandTerm,
    CommandTermCfg,
    ManagerTermBase,
    RewardTermCfg,
    SceneEntityCfg,
)
from wheelleg_exp.isaaclab.markers import VisualizationMarkersCfg
from wheelleg_exp.isaaclab.markers.config import FRAME_MARKER_CFG
from wheelleg_exp.isaaclab.sensors import ContactSensor
from wheelleg_exp.isaaclab.utils import configclass

if TYPE_CHECKING:
    from wheelleg_exp.isaaclab.envs import ManagerBasedEnv, ManagerBasedRLEnv


def height_above(env: ManagerBasedRLEnv, minimum: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")):  # noqa: B008
    asset: RigidObject = env.scene[asset_cfg.name]
    return torch.clamp(asset.data.root_pos_w[:, 2] - minimum, min=0.0)


def scaled_height(env: ManagerBasedRLEnv, scale: float) -> torch.Tensor:
    return scale * env.scene["robot"].data.root_pos_w[:, 2:3]


def air_time(env: ManagerBasedRLEnv, sensor_cfg: SceneEntityCfg, threshold: float) -> torch.Tensor:
    sensor: ContactSensor = env.scene.sensors[sensor_cfg.name]
    first = sensor.compute_first_contact(env.step_dt)[:, sensor_cfg.body_ids]
    return torch.sum((sensor.data.last_air_time[:, sensor_cfg.body_ids] - threshold) * first, dim=1)


class Smoothness(ManagerTermBase):
    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRLEnv):
        super().__init__(cfg, env)
        self.asset: Articulation = env.scene[cfg.params["asset_cfg"].name]
        self.last = torch.zeros(self.num_envs, 2, device=self.device)
        self.seen_weight = cfg.weight

    def reset(self, env_ids=None):
        self.last[env_ids] = 0.0

    def __call__(self, env: ManagerBasedRLEnv, scale: float, asset_cfg: SceneEntityCfg) -> torch.Tensor:
        now = self.asset.data.joint_vel[:, asset_cfg.joint_ids]
        change = torch.sum(torch.square(now - self.last), dim=1)
        self.last[:] = now
        return scale * change


def jolt(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    spread: float,
    asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),  # noqa: B008
):
    asset: Articulation = env.scene[asset_cfg.name]
    state = asset.data.default_root_state[env_ids].clone()
    state[:, 0:3] += env.scene.env_origins[env_ids]
    state[:, 0:2] += math_utils.sample_uniform(-spread, spread, (len(env_ids), 2), device=asset.device)
    state[:, 7:10] += torch.empty(len(env_ids), 3, device=env.device).uniform_(-spread, spread)
    asset.write_root_pose_to_sim(state[:, :7], env_ids=env_ids)
    asset.write_root_velocity_to_sim(state[:, 7:], env_ids=env_ids)


def scatter(env: ManagerBasedEnv, env_ids: torch.Tensor, spread: float, asset_cfg: SceneEntityCfg):
    mdp.reset_root_state_uniform(env, env_ids, {"x": (-spread, spread)}, {})
    mdp.reset_joints_by_offset(env, env_ids, (-spread, spread), (0.0, 0.0), asset_cfg)


@configclass
class TorqueActionCfg(ActionTermCfg):
    joint_names: list[str] = MISSING
    scale: float = 1.0
    limits: dict = {"low": -1.0, "high": 1.0}  # noqa: RUF012


class TorqueAction(ActionTerm):
    cfg: TorqueActionCfg

    def __init__(self, cfg: TorqueActionCfg, env: ManagerBasedEnv):
        super().__init__(cfg, env)
        self._joint_ids, self._names = self._asset.find_joints(self.cfg.joint_names)
        self._raw = torch.zeros(self.num_envs, self.action_dim, device=self.device)
        self._processed = torch.zeros_like(self._raw)

    @property
    def action_dim(self) -> int:
        return len(self._joint_ids)

    @property
    def raw_actions(self) -> torch.Tensor:
        return self._raw

    @property
    def processed_actions(self) -> torch.Tensor:
        return self._processed

    def process_actions(self, actions):
        self._raw[:] = actions
        self._processed[:] = (self._raw * self.cfg.scale).clamp(self.cfg.limits["low"], self.cfg.limits["high"])

    def apply_actions(self):
        self._asset.set_joint_effort_target(self._processed, joint_ids=self._joint_ids)

    def reset(self, env_ids=None):
        self._raw[env_ids] = 0.0


@configclass
class HopCommandCfg(CommandTermCfg):
    goal_visualizer_cfg: VisualizationMarkersCfg = FRAME_MARKER_CFG.replace(prim_path="/Visuals/goal")
    heights: tuple[float, float] = MISSING


class HopCommand(CommandTerm):
    def __init__(self, cfg: HopCommandCfg, env: ManagerBasedEnv):
        super().__init__(cfg, env)
        self.height = torch.zeros(self.num_envs, 1, device=self.device)
        self.metrics["asked"] = torch.zeros(self.num_envs, device=self.device)

    @property
    def command(self) -> torch.Tensor:
        return self.height

    def _update_metrics(self):
        self.metrics["asked"] += self.height[:, 0]

    def _resample_command(self, env_ids):
        self.height[env_ids, 0] = torch.empty(len(env_ids), device=self.device).uniform_(*self.cfg.heights)

    def _update_command(self):
        pass
