"""Actions: what a policy's output means, applied at every physics step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.face import Env
from wheelleg_exp.managers.manager_base import ManagerBase, table
from wheelleg_exp.managers.term import TermBase


class ActionTerm(TermBase):
    """A slice of the action vector."""

    action_dim: int
    raw_actions: torch.Tensor
    processed_actions: torch.Tensor

    def process_actions(self, actions: torch.Tensor) -> None:
        """Take up raw actions (N, action_dim), once per control step."""
        raise NotImplementedError

    def apply_actions(self) -> None:
        """Set targets, once per physics step."""
        raise NotImplementedError


class ActionManager(ManagerBase):
    """Splits the action vector over the terms, in declaration order."""

    kind = "actions"

    def __init__(self, nodes: Mapping[str, Any] | None, env: Env) -> None:
        super().__init__(nodes, env)
        self._action_terms: dict[str, ActionTerm] = {}
        for name, term in self._terms.items():
            if not isinstance(term.func, ActionTerm):
                raise ConfigError(f"'{term.target}' is no action term", key=term.path, expected="an action term")
            self._action_terms[name] = term.func
        self.action = torch.zeros(self._num_envs, self.total_action_dim)
        self.prev_action = torch.zeros_like(self.action)

    @property
    def action_term_dim(self) -> list[int]:
        """Width of each term."""
        return [term.action_dim for term in self._action_terms.values()]

    @property
    def total_action_dim(self) -> int:
        """Width of the action vector."""
        return sum(self.action_term_dim)

    def get_action_term(self, name: str) -> ActionTerm:
        """Return an action term by name."""
        self.get_term(name)
        return self._action_terms[name]

    def process_action(self, action: torch.Tensor) -> None:
        """Take up the raw action (N, total) of this control step; it is not clipped.

        Raises:
            ValueError: the shape is another.
        """
        if action.shape != self.action.shape:
            raise ValueError(f"actions have shape {tuple(action.shape)}, expected {tuple(self.action.shape)}")
        self.prev_action.copy_(self.action)
        self.action.copy_(action)
        start = 0
        for term in self._action_terms.values():
            term.process_actions(self.action[:, start : start + term.action_dim])
            start += term.action_dim

    def apply_action(self) -> None:
        """Let every term set its targets, before each physics step."""
        for term in self._action_terms.values():
            term.apply_actions()

    def reset(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Zero the actions of ``env_ids``."""
        self.action[env_ids] = 0.0
        self.prev_action[env_ids] = 0.0
        self._reset_terms(env_ids)
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return the last two actions and the terms' states."""
        return {
            **super().state_dict(),
            "action": self.action.clone(),
            "prev_action": self.prev_action.clone(),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        self.action.copy_(saved["action"])
        self.prev_action.copy_(saved["prev_action"])

    def __str__(self) -> str:
        rows = [
            (i, name, term.action_dim, self._terms[name].target.rsplit(".", 1)[-1])
            for i, (name, term) in enumerate(self._action_terms.items())
        ]
        return table(f"Actions: {self.total_action_dim}", ("index", "name", "width", "term"), rows)
