"""An environment of chosen numbers, for formulas."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

from wheelleg_exp.managers import SceneEntityCfg


def entity(name: str = "robot", joints: list[int] | None = None, bodies: list[int] | None = None) -> SceneEntityCfg:
    """Return a resolved entity."""
    cfg = SceneEntityCfg(name)
    if joints is not None:
        cfg.joint_ids = torch.tensor(joints)
    if bodies is not None:
        cfg.body_ids = torch.tensor(bodies)
    return cfg


def fake_env(**fields: Any) -> Any:
    """Return an environment: ``data_<name>`` goes to the robot's data, the rest to the environment."""
    data = {k[5:]: v for k, v in fields.items() if k.startswith("data_")}
    robot = SimpleNamespace(data=SimpleNamespace(**data))
    norm = fields.pop("contact_norm", None)
    sensor = SimpleNamespace(max_force_norm=lambda: norm)
    members = {"robot": robot, "contact": sensor}

    class Scene(dict):
        contact_sensor = dict.__getitem__

    scene = Scene(members)
    scene.robot = robot
    scene.env_origins = fields.pop("env_origins", None)
    rest = {k: v for k, v in fields.items() if not k.startswith("data_")}
    return SimpleNamespace(scene=scene, **rest)
