"""How high and how tilted the base is to be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args

import torch

from wheelleg_exp.constraints import Broken, Interval, PositiveInterval, relation
from wheelleg_exp.managers import Env, member
from wheelleg_exp.mdp.commands.ranges import RangedCommand

_Axis = Literal["height", "roll", "pitch"]


def _height_is_given(given: Mapping[str, Any]) -> Iterator[Broken]:
    if "height" not in given["ranges"]:
        yield Broken("ranges.height", "is missing", "[low, high] in metres above the ground")


@relation(_height_is_given)
class UniformBasePoseCommand(RangedCommand):
    """Height of the base above the ground, m, and its roll and pitch, rad, uniform in their ranges.

    What legs with wheels can do while they drive; ``errors`` says how the three are measured, so that rewards can
    track them.

    Args:
        env: the environment.
        ranges: ``height`` of the root link above the ground below it (m), ``roll`` and ``pitch`` (rad, 0 when absent).
        resampling_time_range: shortest and longest time between two draws, s.
        generator: the term's random stream.
        asset_name: the member of the scene that is commanded.
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[_Axis, Interval],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, resampling_time_range, [f"error_{axis}" for axis in get_args(_Axis)], generator)
        self.robot = member(env.scene, asset_name, "asset_name")
        self.take_ranges(ranges, get_args(_Axis))
        self._command = torch.zeros(env.num_envs, 3, device=env.device)

    @property
    def command(self) -> torch.Tensor:
        """The present command (N, 3): height, m, roll and pitch, rad."""
        return self._command

    def measured(self) -> torch.Tensor:
        """Return the present height, m, roll and pitch, rad, (N, 3), of R = Rz(yaw) Ry(pitch) Rx(roll)."""
        data = self.robot.data
        height = data.root_pos_w[:, 2] - self._env.scene.terrain.height_at(data.root_pos_w[:, :2])
        x, y, z = data.projected_gravity_b.unbind(dim=1)
        return torch.stack((height, torch.atan2(-y, -z), torch.asin(x.clamp(-1.0, 1.0))), dim=1)

    def errors(self) -> torch.Tensor:
        """Return the sizes of the differences of height, m, roll and pitch, rad, (3, N)."""
        return (self._command - self.measured()).abs().T

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draw heights and tilts."""
        low, high = self.bounds()
        u = torch.rand(len(env_ids), 3, generator=self._generator, device=self._command.device)
        self._command[env_ids] = low + (high - low) * u
