"""Joint targets as they were some physics steps ago."""

from __future__ import annotations

from collections.abc import Sequence

import torch

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

    settings = ("_ids", "_rows")

    def __init__(
        self, bounds: Sequence[int], joint_ids: torch.Tensor, shape: tuple[int, int], generator: torch.Generator
    ) -> None:
        device = joint_ids.device
        self._low, self._high = bounds
        self._ids = joint_ids
        self._generator = generator
        self._rows = torch.arange(shape[0], device=device)
        self.lag = torch.zeros(shape[0], dtype=torch.long, device=device)
        self._is_first = torch.ones(shape[0], 1, 1, 1, dtype=torch.bool, device=device)
        self._past = torch.zeros(shape[0], self._high + 1, 3, len(joint_ids), device=device)
        self._seen = torch.zeros(shape[0], 3, shape[1], device=device)
        self.targets = JointTargets(*self._seen.unbind(dim=1))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the targets of ``env_ids`` and draw their lags."""
        size = (len(env_ids),)
        self.lag[env_ids] = torch.randint(
            self._low, self._high + 1, size, generator=self._generator, device=env_ids.device
        )
        self._is_first[env_ids] = True

    def push(self, targets: JointTargets) -> JointTargets:
        """Take the targets of a physics step, and return those that act in it; other joints' are not kept."""
        ids = self._ids
        now = torch.stack((targets.pos[:, ids], targets.vel[:, ids], targets.effort[:, ids]), dim=1).unsqueeze(1)
        earlier = torch.where(self._is_first, now, self._past[:, :-1])
        self._past.copy_(torch.cat((now, earlier), dim=1))
        self._is_first.fill_(False)
        self._seen[:, :, ids] = self._past[self._rows, self.lag]
        return self.targets
