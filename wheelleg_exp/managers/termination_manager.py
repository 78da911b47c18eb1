"""Terminations: when an episode ends, and whether it failed or its time was up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch

from wheelleg_exp.constraints import Terms
from wheelleg_exp.definitions import NOT_FINITE, ending
from wheelleg_exp.managers.manager_base import ManagerBase, Term
from wheelleg_exp.managers.return_checks import TensorForm
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import narrowed


class TerminationManager(ManagerBase):
    """Evaluates the termination terms.

    Termination terms with ``time_out`` truncate the episode; all other termination terms terminate it. An episode can
    be truncated and terminated in the same step.

    Attributes:
        fired: where each term fired in this step, (terms, N) bool.
        terminated: environments (N,) bool whose episode failed in this step.
        time_outs: environments (N,) bool whose episode was truncated in this step.
    """

    kind = "terminations"
    columns = ("time-out",)

    def __init__(self, nodes: Terms, env: Env) -> None:
        super().__init__(nodes, env)
        flags = [bool(term.fields.get("time_out", False)) for term in self._terms.values()]
        self._time_out_rows, self._failure_rows = (
            narrowed([row for row, flag in enumerate(flags) if flag is wanted], env.device) for wanted in (True, False)
        )
        fired = torch.zeros(len(self._terms), self._num_envs, dtype=torch.bool, device=env.device)
        self.fired = self.buffer("fired", fired)
        for term in self._terms.values():
            term.form = TensorForm(self._num_envs, env.device, torch.bool, what="true or false")
        self._last_episode = self.buffer("_last_episode", torch.zeros_like(fired))
        ended = torch.zeros(self._num_envs, dtype=torch.bool, device=env.device)
        self.terminated = self.buffer("terminated", ended)
        self.time_outs = self.buffer("time_outs", ended.clone())

    @property
    def dones(self) -> torch.Tensor:
        """Mask (N,) of the environments whose episode ended in the last control step."""
        return self.terminated | self.time_outs

    def get_term(self, name: str) -> torch.Tensor:
        """Return a mask (N,) of the environments in which a termination term fired in the present control step."""
        self.get_term_cfg(name)
        return self.fired[self.active_terms.index(name)]

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[float]]]:
        """Return which termination terms fired in this step in one environment, as 1 or 0 by term."""
        flags = self.fired[:, env_idx].tolist()
        return [(name, [float(flag)]) for name, flag in zip(self._terms, flags, strict=True)]

    def endings(self, env_ids: torch.Tensor) -> Counter[str]:
        """Count the episodes of ``env_ids`` (indices or a mask) by the termination that ended them in this step."""
        return _endings(self.active_terms, self.fired[:, env_ids])

    def compute(self, skipped: torch.Tensor | None = None) -> torch.Tensor:
        """Evaluate every term; return a mask (N,) of the environments that end, except those in ``skipped``."""
        if self._terms:
            torch.stack([term(self._env) for term in self._terms.values()], out=self.fired)
        if skipped is not None:
            self.fired &= ~skipped
        for rows, outcome in ((self._time_out_rows, self.time_outs), (self._failure_rows, self.terminated)):
            torch.any(self.fired[rows], dim=0, out=outcome)
        done = self.dones
        torch.where(done, self.fired, self._last_episode, out=self._last_episode)
        return done

    def force(self, env_ids: torch.Tensor) -> torch.Tensor:
        """End the episodes in the environments ``env_ids`` as failures; return the mask (N,) of all ended episodes."""
        self.terminated[env_ids] = True
        self._last_episode[:, env_ids] = self.fired[:, env_ids]
        return self.dones

    def reset(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return ``Episode_Termination/<term>``: share of all environments whose last episode this term ended."""
        shares = self._last_episode.mean(dim=1, dtype=torch.get_default_dtype())
        self._reset_terms(env_ids)
        return {f"Episode_Termination/{n}": v for n, v in zip(self._terms, shares.unbind(), strict=True)}

    def last_endings(self) -> Counter[str]:
        """Count environments by the terms that ended their last episode; the key ``none`` if no term has ended one."""
        found = _endings(self.active_terms, self._last_episode)
        return Counter({"none" if name == NOT_FINITE else name: count for name, count in found.items()})

    def _cells(self, term: Term) -> tuple[object, ...]:
        return (bool(term.fields.get("time_out", False)),)


def _endings(names: Sequence[str], fired: torch.Tensor) -> Counter[str]:
    """Count episodes by termination term; ``fired`` (T, n) is True at [i, j] if term i ended episode j."""
    columns = fired.T.tolist()
    return Counter(ending(name for name, flag in zip(names, column, strict=True) if flag) for column in columns)
