"""Rewards on wheels. None of them is in Isaac Lab."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import NonNegative, Positive
from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.mdp.rewards.pairing import require_pairs
from wheelleg_exp.sim.ids import picked

_SMALLEST = 1e-6  # N: what a force is divided by at least


def wheel_slip(
    env: Env, radius: Positive, sensor_cfg: SceneEntityCfg, asset_cfg: SceneEntityCfg, threshold: NonNegative = 1.0
) -> torch.Tensor:
    """Sum over wheels on the ground of the speed at which their contact point slips, m/s; 0 for rolling.

    With the normal n of the wheel's contact force the point that touches moves at v + w x (-r n), v and w the
    velocity of the wheel's centre of mass and its angular velocity; what of it lies along the ground is slip.

    Args:
        env: the environment.
        radius: r of the wheels, m.
        sensor_cfg: the wheels of a contact sensor.
        asset_cfg: the same bodies of the robot, in the same order.
        threshold: force above which a wheel is on the ground, N.
    """
    data, ids = env.scene[asset_cfg.name].data, asset_cfg.body_ids
    force = picked(env.scene.contact_sensor(sensor_cfg.name).data.net_forces_w, sensor_cfg.body_ids)
    centre, spin = picked(data.body_lin_vel_w, ids), picked(data.body_ang_vel_w, ids)
    require_pairs(force, centre, "asset_cfg.body_names")
    size = torch.linalg.vector_norm(force, dim=-1, keepdim=True)
    normal = force / size.clamp(min=_SMALLEST)
    slip = centre - radius * torch.linalg.cross(spin, normal)
    along = slip - (slip * normal).sum(dim=-1, keepdim=True) * normal
    return (torch.linalg.vector_norm(along, dim=-1) * (size.squeeze(-1) > threshold)).sum(dim=1)


def wheel_spin_in_air_l1(
    env: Env, sensor_cfg: SceneEntityCfg, asset_cfg: SceneEntityCfg, threshold: NonNegative = 1.0
) -> torch.Tensor:
    """Sum of the speeds of the wheels that touch nothing, rad/s.

    Args:
        env: the environment.
        sensor_cfg: the wheels of a contact sensor.
        asset_cfg: their joints, in the same order.
        threshold: force up to which a wheel touches nothing, N.
    """
    flies = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids) <= threshold
    speed = picked(env.scene[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids).abs()
    require_pairs(flies, speed, "asset_cfg.joint_names")
    return (speed * flies).sum(dim=1)
