"""The height of any ground, by rays from above."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import torch

from wheelleg_exp.sim.batch import BatchEngine
from wheelleg_exp.sim.engine import Engine

_FAR = 1e3  # m above the world's origin: where rays begin


class Probe:
    """A model of the ground alone, made when it is first asked.

    Args:
        add_to: adds the ground to a spec.
    """

    def __init__(self, add_to: Callable[[mujoco.MjSpec], None]) -> None:
        self._add_to = add_to
        self._model: mujoco.MjModel | None = None
        self._engine: Engine | None = None

    def model(self) -> mujoco.MjModel:
        """Return the model of the ground alone."""
        if self._model is None:
            spec = mujoco.MjSpec()
            self._add_to(spec)
            self._model = spec.compile()
        return self._model

    def height_at(self, xy: torch.Tensor, beside: float = 0.0) -> torch.Tensor:
        """Return the height of the ground at points (..., 2), m, (...); ``beside`` where there is none."""
        if self._engine is None:
            self._engine = BatchEngine(self.model(), 1, 1)
        far = torch.full_like(xy[..., :1], _FAR)
        origins = torch.cat((xy, far), dim=-1).reshape(1, -1, 3)
        down = torch.tensor([0.0, 0.0, -1.0], device=xy.device).expand_as(origins)
        distance = self._engine.ray(origins, down).reshape(xy.shape[:-1])
        return torch.where(distance < 0, beside, _FAR - distance).to(xy)
