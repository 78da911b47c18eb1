"""Terminations: when an episode ends, and whether it failed or its time was up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from wheelleg_exp.definitions import NOT_FINITE, ending
from wheelleg_exp.managers.manager_base import ManagerBase, table
from wheelleg_exp.managers.return_checks import TensorForm
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import narrowed


class TerminationManager(ManagerBase):
    """``time_out`` terms truncate, all others terminate; both may fire in one step."""

    kind = "terminations"

    def __init__(self, nodes: Mapping[str, Any] | None, env: Env) -> None:
        super().__init__(nodes, env)
        flags = [bool(term.fields.get("time_out", False)) for term in self._terms.values()]
        self._time_out_rows, self._failure_rows = (
            narrowed([row for row, flag in enumerate(flags) if flag is wanted], env.device) for wanted in (True, False)
        )
        self._fired = torch.zeros(len(self._terms), self._num_envs, dtype=torch.bool, device=env.device)
        for term in self._terms.values():
            term.form = TensorForm(self._num_envs, env.device, torch.bool, what="true or false")
        self._last_episode = torch.zeros_like(self._fired)
        self.terminated = torch.zeros(self._num_envs, dtype=torch.bool, device=env.device)
        self.time_outs = torch.zeros(self._num_envs, dtype=torch.bool, device=env.device)

    @property
    def dones(self) -> torch.Tensor:
        """Which environments ended their episode in this step, (N,) bool."""
        return self.terminated | self.time_outs

    @property
    def fired(self) -> torch.Tensor:
        """Where each term fired in this step, (terms, N) bool."""
        return self._fired

    def get_term(self, name: str) -> torch.Tensor:
        """Return where a term fired in this step, (N,) bool."""
        self.get_term_cfg(name)
        return self._fired[self.active_terms.index(name)]

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[float]]]:
        """Return which terms fired in this step in one environment, 1 or 0 by term."""
        flags = self._fired[:, env_idx].tolist()
        return [(name, [float(flag)]) for name, flag in zip(self._terms, flags, strict=True)]

    def endings(self, env_ids: torch.Tensor) -> Counter[str]:
        """Return how many environments each termination ends in this step; each environment counts once.

        Args:
            env_ids: indices, or a mask (N,).
        """
        return _endings(self.active_terms, self._fired[:, env_ids])

    def compute(self, skipped: torch.Tensor | None = None) -> torch.Tensor:
        """Evaluate every term and return which environments are done, (N,) bool.

        Args:
            skipped: environments (N,) bool whose episode cannot end in this step.
        """
        if self._terms:
            torch.stack([term(self._env) for term in self._terms.values()], out=self._fired)
        if skipped is not None:
            self._fired &= ~skipped
        for rows, outcome in ((self._time_out_rows, self.time_outs), (self._failure_rows, self.terminated)):
            torch.any(self._fired[rows], dim=0, out=outcome)
        done = self.dones
        torch.where(done, self._fired, self._last_episode, out=self._last_episode)
        return done

    def force(self, env_ids: torch.Tensor) -> torch.Tensor:
        """End the episodes of ``env_ids`` as failed, even if no term fired, and return all that are done."""
        self.terminated[env_ids] = True
        self._last_episode[:, env_ids] = self._fired[:, env_ids]
        return self.dones

    def reset(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Return ``Episode_Termination/<term>``: share of all environments whose last episode this term ended."""
        shares = self._last_episode.mean(dim=1, dtype=torch.get_default_dtype())
        self._reset_terms(env_ids)
        return {f"Episode_Termination/{n}": v for n, v in zip(self._terms, shares.unbind(), strict=True)}

    def last_endings(self) -> Counter[str]:
        """Return for how many environments each termination ended the last episode; each environment counts once.

        Environments whose last episode no termination ended, or that have not finished one yet, count as ``none``.
        """
        found = _endings(self.active_terms, self._last_episode)
        return Counter({"none" if name == NOT_FINITE else name: count for name, count in found.items()})

    def state_dict(self) -> dict[str, Any]:
        """Return which terms ended the last episodes, the result of this step, and the states of the terms."""
        return {
            **super().state_dict(),
            "last_episode": self._last_episode.clone(),
            "fired": self._fired.clone(),
            "terminated": self.terminated.clone(),
            "time_outs": self.time_outs.clone(),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        self._last_episode.copy_(saved["last_episode"])
        self._fired.copy_(saved["fired"])
        self.terminated.copy_(saved["terminated"])
        self.time_outs.copy_(saved["time_outs"])

    def __str__(self) -> str:
        rows = [
            (i, name, bool(term.fields.get("time_out", False)), term.target.rsplit(".", 1)[-1])
            for i, (name, term) in enumerate(self._terms.items())
        ]
        return table(f"Terminations: {len(rows)}", ("index", "name", "time-out", "term"), rows)


def _endings(names: Sequence[str], fired: torch.Tensor) -> Counter[str]:
    """Count environments by the terms that fired (T, n). Terms that fired together count as one combined name."""
    columns = fired.T.tolist()
    return Counter(ending(name for name, flag in zip(names, column, strict=True) if flag) for column in columns)
