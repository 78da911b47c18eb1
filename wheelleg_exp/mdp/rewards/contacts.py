"""Rewards on contact forces."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import NonNegative
from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.sim.ids import picked


def undesired_contacts(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Number of bodies whose contact force exceeded ``threshold`` (N) within the sensor's history."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force > threshold).sum(dim=1).float()


def no_contact_count(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Number of bodies whose contact force stayed at or below ``threshold`` (N) within the sensor's history.

    Not in Isaac Lab: the number of wheels in the air.
    """
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force <= threshold).sum(dim=1).float()


def no_desired_contact(env: Env, sensor_cfg: SceneEntityCfg, threshold: NonNegative = 1.0) -> torch.Tensor:
    """1 where none of the bodies exceeded ``threshold`` (N) within the sensor's history.

    Isaac Lab calls it ``desired_contacts``, which names the opposite.
    """
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (~(force > threshold).any(dim=1)).float()


desired_contacts = no_desired_contact


def contact_forces(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Sum of the contact forces beyond ``threshold``, N."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force - threshold).clamp(min=0.0).sum(dim=1)
