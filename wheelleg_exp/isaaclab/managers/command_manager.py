"""Command terms as Isaac Lab writes them."""

from __future__ import annotations

from typing import Any

import torch

from wheelleg_exp import managers
from wheelleg_exp.isaaclab.managers.manager_term_cfg import CommandTermCfg
from wheelleg_exp.managers import Env
from wheelleg_exp.sim.ids import fill_rows, ids_where


class CommandTerm(managers.CommandTerm):
    """A command term made by ``(cfg, env)``, with ``_resample_command``, ``_update_command``, ``_update_metrics``.

    Args:
        cfg: the parameters of the YAML node, as the class that annotates ``cfg`` in the subclass's ``__init__``.
        env: the environment.

    Attributes:
        metrics: what the log tells of the episodes that end, (N,) by name; the subclass fills it.
    """

    metrics: Any

    def __init__(self, cfg: CommandTermCfg, env: Env) -> None:
        self.cfg = cfg
        # Without a stream of its own it draws from the global generator, which is the term's stream while it runs.
        super().__init__(env, cfg.resampling_time_range, (), None)  # type: ignore[arg-type]
        self.metrics: dict[str, torch.Tensor] = {}

    @property
    def num_envs(self) -> int:
        """Number of environments, N."""
        return self._env.num_envs

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self._env.device

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        """Draw new commands for ``env_ids``."""
        raise NotImplementedError

    def _update_command(self) -> None:
        """Derive the command from what was drawn, every step."""

    def _update_metrics(self) -> None:
        """Take this step's metrics up."""

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draw new commands for ``env_ids``."""
        self._resample_command(env_ids)

    def compute(self, dt: float) -> torch.Tensor:
        """Update the metrics, resample where the time is up, update the command."""
        self._update_metrics()
        self.time_left -= dt
        expired = ids_where(self.time_left <= 0.0)
        if len(expired):
            self._resample(expired)
        self._update_command()
        return self.error_sums

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the metrics' means over ``env_ids``, zero them, and draw anew."""
        log = {name: value[env_ids].mean() for name, value in self.metrics.items()}
        for value in self.metrics.values():
            fill_rows(value, env_ids, 0.0)
        fill_rows(self.command_counter, env_ids, 0)
        self._resample(env_ids)
        return log
