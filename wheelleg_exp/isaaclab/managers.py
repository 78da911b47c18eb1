"""Contents of ``isaaclab.managers``: entities, managers, base classes of terms, and the configs of terms."""

from __future__ import annotations

from typing import Any

import torch

from wheelleg_exp import managers
from wheelleg_exp.isaaclab.utils.configclass import configclass
from wheelleg_exp.managers import (
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
from wheelleg_exp.sim.ids import fill_rows, ids_where

__all__ = [
    "ActionManager",
    "ActionTerm",
    "ActionTermCfg",
    "CommandManager",
    "CommandTerm",
    "CommandTermCfg",
    "CurriculumManager",
    "CurriculumTermCfg",
    "EventManager",
    "EventTermCfg",
    "ManagerTermBase",
    "ManagerTermBaseCfg",
    "ObservationManager",
    "ObservationTermCfg",
    "RewardManager",
    "RewardTermCfg",
    "SceneEntityCfg",
    "TerminationManager",
    "TerminationTermCfg",
]

ManagerTermBaseCfg = Term
RewardTermCfg = ObservationTermCfg = TerminationTermCfg = EventTermCfg = CurriculumTermCfg = Term


@configclass
class ActionTermCfg:
    """The config of an action: the YAML node's parameters as attributes.

    Attributes:
        class_type: unused, because the node's ``_target_`` is the class.
        asset_name: the robot's name in the scene.
        debug_vis: unused.
        clip: bounds by joint expression, which the term applies.
    """

    class_type: Any = None
    asset_name: str = "robot"
    debug_vis: bool = False
    clip: dict[str, tuple[float, float]] | None = None


@configclass
class CommandTermCfg:
    """The config of a command: the YAML node's parameters as attributes.

    Attributes:
        class_type: unused, because the node's ``_target_`` is the class.
        resampling_time_range: shortest and longest time between two draws, s.
        debug_vis: unused.
    """

    class_type: Any = None
    resampling_time_range: tuple[float, float] = (10.0, 10.0)
    debug_vis: bool = False


class _OfEnv:
    """The attributes of a term that Isaac Lab's terms read from ``self``."""

    _env: Env

    @property
    def num_envs(self) -> int:
        """Number of environments, N."""
        return self._env.num_envs

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self._env.device


class ActionTerm(_OfEnv, managers.ActionTerm):
    """An action term with the constructor ``(cfg, env)``.

    A subclass defines ``action_dim``, ``raw_actions`` and ``processed_actions``.

    Args:
        cfg: the parameters of the YAML node, as the class that annotates ``cfg`` in the subclass's ``__init__``.
        env: the environment.
    """

    def __init__(self, cfg: ActionTermCfg, env: Env) -> None:
        self.cfg = cfg
        self._env = env
        self._asset = env.scene[cfg.asset_name]


class CommandTerm(_OfEnv, managers.CommandTerm):
    """A command term with the constructor ``(cfg, env)``.

    A subclass defines ``_resample_command``, ``_update_command`` and ``_update_metrics``.

    Args:
        cfg: the parameters of the YAML node, as the class that annotates ``cfg`` in the subclass's ``__init__``.
        env: the environment.

    Attributes:
        metrics: log entries of the episodes that end, (N,) by name, which the subclass fills.
    """

    metrics: Any

    def __init__(self, cfg: CommandTermCfg, env: Env) -> None:
        self.cfg = cfg
        # The term has no generator: it draws from torch's global generator, which is the term's stream while it runs.
        super().__init__(env, cfg.resampling_time_range, (), None)  # type: ignore[arg-type]
        self.metrics: dict[str, torch.Tensor] = {}

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        """Draw new commands for ``env_ids``."""
        raise NotImplementedError

    def _update_command(self) -> None:
        """Compute the command from the drawn values in every step."""

    def _update_metrics(self) -> None:
        """Update the metrics in every step."""

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
