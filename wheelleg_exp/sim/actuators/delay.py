"""Joint targets as they were some physics steps ago."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from wheelleg_exp.sim.delay import DelayBuffer
from wheelleg_exp.sim.layout import JointTargets
from wheelleg_exp.state import Stateful


class TargetDelay(Stateful):
    """Keeps the targets of a group of joints, and gives those of some physics steps ago.

    One lag an environment holds for positions, velocities and efforts. It is drawn at each reset, uniformly on whole
    steps, and is 0 before the first. The first targets after a reset stand for all that came before them.

    Args:
        bounds: fewest and most physics steps.
        joint_ids: the group's joints, (k,).
        shape: environments and joints of the robot, (N, J).
        generator: the group's random stream.
    """

    settings = ("_ids",)

    def __init__(
        self, bounds: Sequence[int], joint_ids: torch.Tensor, shape: tuple[int, int], generator: torch.Generator
    ) -> None:
        device = joint_ids.device
        self._ids = joint_ids
        self._past = DelayBuffer(torch.zeros(shape[0], 3, len(joint_ids), device=device), bounds, generator)
        self._seen = torch.zeros(shape[0], 3, shape[1], device=device)
        self.targets = JointTargets(*self._seen.unbind(dim=1))

    @property
    def lag(self) -> torch.Tensor:
        """The lag of each environment, physics steps, (N,)."""
        return self._past.lag

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the targets of ``env_ids`` and draw their lags."""
        self._past.reset(env_ids)

    def push(self, targets: JointTargets) -> JointTargets:
        """Take the targets of a physics step, and return those that act in it; other joints' are not kept."""
        ids = self._ids
        now = torch.stack((targets.pos[:, ids], targets.vel[:, ids], targets.effort[:, ids]), dim=1)
        self._seen[:, :, ids] = self._past.push(now)
        return self.targets
