"""Rewards for going on, and for the episode's end."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Names
from wheelleg_exp.managers import Env, TermBase
from wheelleg_exp.sim.names import match_names


def is_alive(env: Env) -> torch.Tensor:
    """1 unless the episode failed in this step; a time-out counts as alive."""
    return (~env.termination_manager.terminated).float()


def is_terminated(env: Env) -> torch.Tensor:
    """1 where the episode failed in this step; time-outs excluded."""
    return env.termination_manager.terminated.float()


class is_terminated_term(TermBase):
    """Number of the matching terminations that fired in this step, 0 on a time-out.

    Args:
        env: the environment.
        term_keys: expressions of termination names; by default all.
    """

    def __init__(self, env: Env, term_keys: Names = ".*") -> None:
        names = env.termination_manager.active_terms
        self._names = match_names(term_keys, names, key="term_keys", what="termination")[1]

    def __call__(self, env: Env) -> torch.Tensor:
        """Count."""
        manager = env.termination_manager
        fired = torch.stack([manager.get_term(name) for name in self._names]).sum(dim=0)
        return (fired * ~manager.time_outs).float()
