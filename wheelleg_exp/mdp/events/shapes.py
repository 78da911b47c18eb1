"""Materials of the robot's shapes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch

from wheelleg_exp.constraints import Count, NonNegativeInterval, Ordered, Share
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.mdp.events.draws import all_ids
from wheelleg_exp.sim import rotation

_ROBOT = SceneEntityCfg("robot")


class randomize_rigid_body_material(TermBase):
    """Give each shape of each environment one of ``num_buckets`` materials, drawn once at construction.

    PhysX averages the coefficients of the two touching shapes and MuJoCo takes the larger: the effective value
    (robot + ground) / 2 is written, which the robot's higher contact priority makes MuJoCo use. MuJoCo has one
    Coulomb coefficient; ``env.robot.friction_source`` says which of the two it is. Restitution is drawn and kept
    in ``materials``, but has no counterpart and does not act.

    Args:
        env: the environment.
        static_friction_range: [low, high].
        dynamic_friction_range: [low, high].
        restitution_range: [low, high].
        num_buckets: number of different materials.
        generator: the term's random stream.
        make_consistent: whether dynamic friction is cut to static friction.
        asset_cfg: the bodies whose shapes are written.
    """

    def __init__(
        self,
        env: Env,
        static_friction_range: NonNegativeInterval,
        dynamic_friction_range: NonNegativeInterval,
        restitution_range: Annotated[Sequence[Share], Ordered()],
        num_buckets: Count,
        generator: torch.Generator,
        make_consistent: bool = False,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        pairs = (static_friction_range, dynamic_friction_range, restitution_range)
        ranges = torch.tensor(pairs, dtype=torch.float32, device=env.device)
        self._generator = generator
        self.buckets = rotation.uniform(ranges[:, 0], ranges[:, 1], num_buckets, generator)
        if make_consistent:
            self.buckets[:, 1] = torch.minimum(self.buckets[:, 0], self.buckets[:, 1])
        robot = env.scene[asset_cfg.name]
        self._geom_ids = robot.shape_ids(asset_cfg.body_ids)
        source = robot.options.friction_source
        self._column = 0 if source == "static" else 1
        self._ground = env.scene.terrain.friction(source)
        self.materials = torch.zeros(env.num_envs, len(self._geom_ids), 3, device=env.device)

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        """Draw a bucket per environment and shape, and write the effective friction."""
        ids = all_ids(env, env_ids)
        chosen = torch.randint(
            len(self.buckets), (len(ids), len(self._geom_ids)), generator=self._generator, device=ids.device
        )
        self.materials[ids] = self.buckets[chosen]
        effective = (self.materials[ids, :, self._column] + self._ground) / 2
        env.scene.sim.expand("geom_friction")[ids.unsqueeze(1), self._geom_ids, 0] = effective.to(env.scene.sim.dtype)
