"""Where a sensor sits: a body of the robot, and a pose in its frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import torch

from wheelleg_exp.constraints import Broken
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state import Kept

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot

Offset = Mapping[Literal["pos", "rot"], Sequence[float]]


def offset_fits(given: Mapping[str, Any]) -> Iterator[Broken]:
    """Hold an ``offset`` against its form: ``pos`` (x, y, z), m, and ``rot`` (w, x, y, z)."""
    offset = given["offset"] or {}
    if len(offset.get("pos", (0, 0, 0))) != 3:
        yield Broken("offset.pos", f"{offset['pos']!r} is no position", "3 finite numbers")
    if len(offset.get("rot", (1, 0, 0, 0))) != 4 or not any(offset.get("rot", (1, 0, 0, 0))):
        yield Broken(
            "offset.rot", f"{offset['rot']!r} is no orientation", "4 finite numbers (w, x, y, z), not all zero"
        )


def offset_pose(offset: Offset | None, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an offset's position (3,), m, and unit quaternion (4,)."""
    given = offset or {}
    pos = torch.tensor(given.get("pos", (0.0, 0.0, 0.0)), device=device)
    rot = torch.tensor(given.get("rot", (1.0, 0.0, 0.0, 0.0)), device=device)
    return pos, torch.nn.functional.normalize(rot, dim=0)


class Mount(Kept):
    """The body of the robot that a sensor sits on.

    Args:
        expression: names the body.
        robot: the robot, whose names are known.
        key: the config key of the expression.

    Raises:
        ConfigError: it matches no body, or several.
    """

    def __init__(self, expression: str, robot: Robot, key: str) -> None:
        found, names = robot.find_bodies([expression], key=key)
        if len(names) > 1:
            raise ConfigError(f"'{expression}' matches {', '.join(names)}", key=key, expected="one body")
        self.body, self.index, self._robot = names[0], found[0], robot

    @property
    def pos_w(self) -> torch.Tensor:
        """Position of the body's frame, m, (N, 3)."""
        # A free root's pose is state; that of any other link makes MuJoCo compute it behind each step.
        data = self._robot.data
        return data.root_pos_w if self.index == 0 else data.body_pos_w[:, self.index]

    @property
    def quat_w(self) -> torch.Tensor:
        """Orientation of the body's frame (w, x, y, z), (N, 4)."""
        data = self._robot.data
        return data.root_quat_w if self.index == 0 else data.body_quat_w[:, self.index]

    @property
    def rot_w(self) -> torch.Tensor:
        """Rotation matrix of the body's frame, (N, 3, 3)."""
        data = self._robot.data
        return data.root_rot_w if self.index == 0 else data.body_rot_w[:, self.index]

    @property
    def lin_vel_w(self) -> torch.Tensor:
        """Velocity of the origin of the body's frame, m/s, world axes, (N, 3)."""
        data = self._robot.data
        return data.root_link_lin_vel_w if self.index == 0 else data.body_link_lin_vel_w[:, self.index]

    @property
    def ang_vel_w(self) -> torch.Tensor:
        """Angular velocity of the body, rad/s, world axes, (N, 3)."""
        data = self._robot.data
        return data.root_ang_vel_w if self.index == 0 else data.body_ang_vel_w[:, self.index]
