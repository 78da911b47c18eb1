"""Contents of ``isaaclab.managers``: entities, managers, base classes of terms, and the configs of terms."""

from __future__ import annotations

from typing import Any

import torch

from wheelleg_exp import managers
from wheelleg_exp.isaaclab.utils.configclass import configclass
from wheelleg_exp.managers import (  # noqa: F401  # ``isaaclab.managers`` exports classes of ``wheelleg_exp.managers``.
    ActionManager,
    CommandManager,
    CurriculumManager,
    Env,
    EventManager,
    ManagerTermBase,
    ObservationManager,
    RewardManager,
    SceneEntityCfg,
    Term,
    TerminationManager,
)
from wheelleg_exp.managers.manager_base import OfEnv
from wheelleg_exp.sim.ids import fill_rows, ids_where

ManagerTermBaseCfg = Term
RewardTermCfg = ObservationTermCfg = TerminationTermCfg = EventTermCfg = CurriculumTermCfg = Term


@configclass
class _TermCfg:
    """The fields of all terms, which have no effect, because ``_target_`` names the class."""

    class_type: Any = None
    debug_vis: bool = False


@configclass
class ActionTermCfg(_TermCfg):
    """The parameters of an action's YAML node: the robot's name in the scene, and ``clip``, bounds by expression."""

    asset_name: str = "robot"
    clip: dict[str, tuple[float, float]] | None = None


@configclass
class CommandTermCfg(_TermCfg):
    """The parameters of a command's YAML node, with the shortest and longest time between two draws, s."""

    resampling_time_range: tuple[float, float] = (10.0, 10.0)


class ActionTerm(OfEnv, managers.ActionTerm):
    """Base class of action terms with Isaac Lab's constructor ``(cfg, env)``.

    A subclass of ``ActionTerm`` defines ``action_dim``, ``raw_actions``, and ``processed_actions``. The type annotation
    of ``cfg`` names the class of ``cfg``; the YAML config gives the attributes of ``cfg``.
    """

    def __init__(self, cfg: ActionTermCfg, env: Env) -> None:
        self.cfg = cfg
        self._env = env
        self._asset = env.scene[cfg.asset_name]


class CommandTerm(OfEnv, managers.CommandTerm):
    """Base class of command terms with Isaac Lab's constructor ``(cfg, env)``; see ``ActionTerm``.

    A subclass of ``CommandTerm`` defines ``_resample_command``, ``_update_command``, and ``_update_metrics``, and
    writes log entries of shape (N,) into the dictionary ``metrics``.
    """

    metrics: Any

    def __init__(self, cfg: CommandTermCfg, env: Env) -> None:
        self.cfg = cfg
        # Pass None as the random generator, because Isaac Lab's command terms draw from torch's global generator.
        super().__init__(env, cfg.resampling_time_range, (), None)  # type: ignore[arg-type]
        self.metrics: dict[str, torch.Tensor] = {}

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        """Draw new commands for ``env_ids``."""
        raise NotImplementedError

    def _update_command(self) -> None:
        """Update the command in every control step, such as the yaw rate towards a commanded heading."""

    def _update_metrics(self) -> None:
        """Update the command's metrics; the command manager calls this method in every control step."""

    def draw(self, env_ids: torch.Tensor) -> None:
        self._resample_command(env_ids)

    def compute(self, dt: float) -> torch.Tensor:
        self._update_metrics()
        self.time_left -= dt
        expired = ids_where(self.time_left <= 0.0)
        if len(expired):
            self._resample(expired)
        self._update_command()
        return self.error_sums

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        log = {name: value[env_ids].mean() for name, value in self.metrics.items()}
        for value in self.metrics.values():
            fill_rows(value, env_ids, 0.0)
        fill_rows(self.command_counter, env_ids, 0)
        self._resample(env_ids)
        return log
