"""Curricula: terms that change the task during training, run at each reset."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from wheelleg_exp.constraints import Terms
from wheelleg_exp.managers.manager_base import ManagerBase
from wheelleg_exp.managers.return_checks import FiguresForm
from wheelleg_exp.managers.term_interface import Env


class CurriculumManager(ManagerBase):
    """Calls each curriculum term with the environments that will be reset, and logs the returned values."""

    kind = "curriculum"

    def __init__(self, nodes: Terms, env: Env) -> None:
        super().__init__(nodes, env)
        self._state: dict[str, object] = self.number("_state", dict.fromkeys(self._terms))
        for term in self._terms.values():
            term.form = FiguresForm()

    def compute(self, env_ids: torch.Tensor) -> None:
        """Run every curriculum term on the episodes that end in this step, before the environments are reset."""
        for name, term in self._terms.items():
            self._state[name] = term(self._env, env_ids)

    def reset(self, env_ids: torch.Tensor) -> dict[str, object]:
        """Return ``Curriculum/<term>`` (or ``Curriculum/<term>/<key>``): the last returned states."""
        log = {}
        for name, state in self._state.items():
            if isinstance(state, Mapping):
                log.update({f"Curriculum/{name}/{key}": _number(value) for key, value in state.items()})
            elif state is not None:
                log[f"Curriculum/{name}"] = _number(state)
        self._reset_terms(env_ids)
        return log

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[object]]]:  # noqa: ARG002
        """Return the last logged values of each curriculum term, which are the same in all environments."""
        states = {name: state for name, state in self._state.items() if state is not None}
        parts = ((name, state.values() if isinstance(state, Mapping) else [state]) for name, state in states.items())
        return [(name, [_number(value) for value in values]) for name, values in parts]


def _number(value: object) -> object:
    return value.item() if isinstance(value, torch.Tensor) and value.ndim == 0 else value
