"""Wrenches and pushes."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Interval
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase, bounds
from wheelleg_exp.mdp.events.draws import POSE, PoseRange, all_ids
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
    """Draw a force (N) and a torque (N·m) that act at the bodies' CoM in link axes until the next reset.

    The same range holds for each axis. Isaac Lab calls it ``apply_external_force_torque``.
    """
    ids = all_ids(env, env_ids)
    robot = env.scene[asset_cfg.name]
    bodies = torch.arange(len(robot.body_names), device=env.device)[asset_cfg.body_ids].tolist()
    pairs = [list(force_range)] * 3 + [list(torque_range)] * 3
    limits = torch.tensor(pairs, dtype=torch.float32, device=env.device)
    drawn = rotation.uniform(limits[:, 0], limits[:, 1], len(ids) * len(bodies), generator)
    robot.set_permanent_wrench(ids, bodies, drawn.view(len(ids), len(bodies), 6))


apply_external_force_torque = set_permanent_body_wrench


class push_by_adding_velocity(TermBase):
    """Add U(range) to the root's CoM velocity, world axes. Isaac Lab calls it ``push_by_setting_velocity``.

    Args:
        env: the environment.
        velocity_range: ``x``, ``y``, ``z`` in m/s; ``roll``, ``pitch``, ``yaw`` in rad/s.
        generator: the term's random stream.
        asset_cfg: the robot.
    """

    adds = True
    settings = ("_low", "_high")

    def __init__(
        self, env: Env, velocity_range: PoseRange, generator: torch.Generator, asset_cfg: SceneEntityCfg = _ROBOT
    ) -> None:
        self._low, self._high = bounds(velocity_range, POSE, "velocity_range", env.device)
        self._generator = generator
        self._robot = env.scene[asset_cfg.name]

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        """Push."""
        ids = all_ids(env, env_ids)
        velocity = rotation.uniform(self._low, self._high, len(ids), self._generator)
        data = self._robot.data
        if self.adds:
            velocity += torch.cat((data.root_lin_vel_w[ids], data.root_ang_vel_w[ids]), dim=1)
        self._robot.write_root_com_velocity(ids, velocity[:, :3], velocity[:, 3:])


push_by_setting_velocity = push_by_adding_velocity


class set_root_velocity(push_by_adding_velocity):
    """Set the root's CoM velocity to U(range), world axes, whatever it was."""

    adds = False
