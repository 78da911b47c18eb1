"""A sensor that is expensive to measure with: it measures when it is read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from wheelleg_exp.constraints import NonNegative
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import fill_rows, ids_where
from wheelleg_exp.sim.sensors.base import SensorBase
from wheelleg_exp.terms.failures import blamed


class LazySensor(SensorBase):
    """Measures when ``data`` is read, at most once of each state; a subclass measures in ``sense`` into ``_data``.

    With an update period it holds what it has measured: each environment is measured at its reset, and at the first
    physics step at which the period is over, whether it is read or not; so reading never changes anything.

    Args:
        update_period: time between two measurements, s; 0 shows the present state at every reading.
    """

    def __init__(self, update_period: NonNegative = 0.0) -> None:
        super().__init__(update_period)
        self._data: Any = None

    def sense(self, ids: torch.Tensor | slice) -> None:
        """Measure some environments: their ids, or a slice of all."""
        raise NotImplementedError("a lazy sensor needs 'sense(ids)'")

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; a subclass makes its ``_data``."""
        super().connect(sim, stream)
        self._outdated: torch.Tensor | slice | None = slice(None)
        self._is_new = torch.ones(sim.num_envs, dtype=torch.bool, device=sim.device)

    @property
    def data(self) -> Any:
        """What was measured; it is not to be written into."""
        if self._outdated is not None:
            with blamed(self.key, self, has_worked=True):  # a term reads, and is not to blame
                self.sense(self._outdated)
            self._outdated = None
        return self._data

    def update(self) -> None:
        """Take up the physics step that has just run."""
        if self.update_period == 0.0:
            self._outdated = slice(None)
        else:
            super().update()

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:  # noqa: ARG002
        """Measure the environments that are due (see ``SensorBase.measure``)."""
        self.sense(slice(None) if due is None else ids_where(due))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Note that ``env_ids`` are to be measured once their new state is there."""
        fill_rows(self._elapsed, env_ids, 0.0)
        fill_rows(self._is_new, env_ids, True)

    def refresh(self, env_ids: torch.Tensor) -> None:
        """Take up the state of ``env_ids`` that has been written; what is held is measured of new episodes alone."""
        if self.update_period == 0.0:
            if not isinstance(self._outdated, slice):
                seen = env_ids if self._outdated is None else torch.cat((self._outdated, env_ids)).unique()
                self._outdated = seen
        else:
            self._outdated = None
            self.sense(env_ids[self._is_new[env_ids]])
        fill_rows(self._is_new, env_ids, False)

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; what is not held is measured anew."""
        super().load_state_dict(saved)
        self._outdated = slice(None) if self.update_period == 0.0 else None
        self._is_new.fill_(False)
