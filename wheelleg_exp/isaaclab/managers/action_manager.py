"""Action terms as Isaac Lab writes them."""

from __future__ import annotations

import torch

from wheelleg_exp import managers
from wheelleg_exp.isaaclab.managers.manager_term_cfg import ActionTermCfg
from wheelleg_exp.managers import Env


class ActionTerm(managers.ActionTerm):
    """An action term made by ``(cfg, env)``: ``action_dim``, ``raw_actions``, ``processed_actions`` are its own.

    Args:
        cfg: the parameters of the YAML node, as the class that annotates ``cfg`` in the subclass's ``__init__``.
        env: the environment.
    """

    def __init__(self, cfg: ActionTermCfg, env: Env) -> None:
        self.cfg = cfg
        self._env = env
        self._asset = env.scene[cfg.asset_name]

    @property
    def num_envs(self) -> int:
        """Number of environments, N."""
        return self._env.num_envs

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self._env.device
