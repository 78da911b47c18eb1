"""Single bodies of the robot."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.ids import picked

_ROBOT = SceneEntityCfg("robot")


def body_pose_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Poses of the links, body by body: position from the environment's origin, m, and (w, x, y, z), (N, 7 B)."""
    data = env.scene[asset_cfg.name].data
    position = picked(data.body_pos_w, asset_cfg.body_ids) - env.scene.env_origins.unsqueeze(1)
    return torch.cat((position, picked(data.body_quat_w, asset_cfg.body_ids)), dim=2).flatten(1)


def body_projected_gravity_b(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Unit gravity direction in the axes of each link, body by body, (N, 3 B)."""
    data = env.scene[asset_cfg.name].data
    gravity = rotation.rotate(data.root_rot_w, data.projected_gravity_b)
    turned = torch.matmul(gravity.view(-1, 1, 1, 3), picked(data.body_rot_w, asset_cfg.body_ids))
    return turned.flatten(1)
