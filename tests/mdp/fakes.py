"""A fake environment whose numbers a test chooses, for tests of formulas."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

from wheelleg_exp.managers import SceneEntityCfg


def entity(name: str = "robot", joints: list[int] | None = None, bodies: list[int] | None = None) -> SceneEntityCfg:
    cfg = SceneEntityCfg(name)
    if joints is not None:
        cfg.joint_ids = torch.tensor(joints)
    if bodies is not None:
        cfg.body_ids = torch.tensor(bodies)
    return cfg


def fake_env(**fields: Any) -> Any:
    """Return an environment whose numbers a test chooses.

    ``data_<name>`` is data of the robot, ``contact`` data of the sensor `contact` by name, ``commands`` are commands by
    name, ``ground`` is the ground's height at points, and ``terrain`` holds further attributes of the ground.
    """
    data = {k[5:]: v for k, v in fields.items() if k.startswith("data_")}
    data.setdefault("joint_pos_measured", data.get("joint_pos"))
    data.setdefault("root_ang_vel_measured", data.get("root_ang_vel_b"))
    data.setdefault("projected_gravity_measured", data.get("projected_gravity_b"))
    robot = SimpleNamespace(data=SimpleNamespace(**data))
    norm = fields.pop("contact_norm", None)
    landed = fields.pop("first_contact", None)
    sensor = SimpleNamespace(
        max_force_norm=lambda: norm,
        compute_first_contact=lambda dt: landed,
        data=SimpleNamespace(**fields.pop("contact", {})),
    )
    members = {"robot": robot, "contact": sensor}

    class Scene(dict):
        contact_sensor = dict.__getitem__

    scene = Scene(members)
    scene.robot, scene.articulations = robot, members
    ground = fields.pop("ground", lambda xy: torch.zeros_like(xy[..., 0]))
    scene.terrain = SimpleNamespace(height_at=ground, **fields.pop("terrain", {}))
    fields.setdefault("command_manager", SimpleNamespace(get_command=fields.pop("commands", {}).__getitem__))
    scene.env_origins = fields.pop("env_origins", None)
    return SimpleNamespace(scene=scene, **{k: v for k, v in fields.items() if not k.startswith("data_")})


def close(got: torch.Tensor, expected: Any) -> None:
    """Check that a reward has the expected values and the type float32."""
    torch.testing.assert_close(got.float(), torch.tensor(expected, dtype=torch.float32), atol=1e-6, rtol=1e-6)
    assert got.dtype == torch.float32


def two_numbers(env: Any) -> torch.Tensor:
    return torch.ones(env.num_envs, 2, device=env.device)
