"""Curricula: terms that change the task during training, run at each reset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from wheelleg_exp.managers.manager_base import ManagerBase
from wheelleg_exp.managers.return_checks import FiguresForm
from wheelleg_exp.managers.term_interface import Env


class CurriculumManager(ManagerBase):
    """Calls each curriculum term with the environments that will be reset, and logs the returned values."""

    kind = "curriculum"

    def __init__(self, nodes: Mapping[str, Any] | None, env: Env) -> None:
        super().__init__(nodes, env)
        self._state: dict[str, Any] = {name: None for name in self._terms}
        for term in self._terms.values():
            term.form = FiguresForm()

    def compute(self, env_ids: torch.Tensor) -> None:
        """Run every curriculum term on the episodes that end in this step, before the environments are reset."""
        for name, term in self._terms.items():
            self._state[name] = term(self._env, env_ids)

    def reset(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Return ``Curriculum/<term>`` (or ``Curriculum/<term>/<key>``): the last returned states."""
        log: dict[str, Any] = {}
        for name, state in self._state.items():
            if isinstance(state, Mapping):
                log |= {f"Curriculum/{name}/{key}": _number(value) for key, value in state.items()}
            elif state is not None:
                log[f"Curriculum/{name}"] = _number(state)
        self._reset_terms(env_ids)
        return log

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[Any]]]:
        """Return the last logged values of each curriculum term, which are the same in all environments."""
        del env_idx
        states = {name: state for name, state in self._state.items() if state is not None}
        parts = ((name, state.values() if isinstance(state, Mapping) else [state]) for name, state in states.items())
        return [(name, [_number(value) for value in values]) for name, values in parts]

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "last": {name: _plain(state) for name, state in self._state.items()}}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        super().load_state_dict(saved)
        self._state = dict(saved["last"])


def _plain(state: Any) -> Any:
    """Convert the logged state of a curriculum to values that a checkpoint can store: arrays become tensors."""
    if isinstance(state, Mapping):
        return {str(key): _plain(value) for key, value in state.items()}
    if isinstance(state, (np.ndarray, np.generic)):
        return torch.as_tensor(np.array(state), device="cpu")
    return state.clone() if isinstance(state, torch.Tensor) else state


def _number(value: Any) -> Any:
    return value.item() if isinstance(value, torch.Tensor) and value.ndim == 0 else value
