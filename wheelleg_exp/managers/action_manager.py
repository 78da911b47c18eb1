"""Actions: the meaning of a policy's output, applied at every physics step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import ClassVar

import torch

from wheelleg_exp.constraints import Terms
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.manager_base import ManagerBase, TermBase, table
from wheelleg_exp.managers.return_checks import require_form, row_form
from wheelleg_exp.managers.sample_history import made_delay
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.names import shared_errors
from wheelleg_exp.terms.term_errors import code_place


class ActionTerm(TermBase):
    """One term of the action vector, which processes its own slice of the vector.

    Attributes:
        drives: kind of the joint targets that the term sets (``position``, ``velocity``, or ``effort``); an empty text
            if the term sets no joint targets.
        joint_names: names of the joints, if the term drives joints.
        action_dim: width of the slice.
    """

    drives: ClassVar[str] = ""
    joint_names: list[str]
    action_dim: int
    raw_actions: torch.Tensor
    processed_actions: torch.Tensor

    @property
    def applies_once(self) -> bool:
        """Whether joint targets are constant during a control step, so that one call of ``apply_actions`` is enough."""
        return False

    def process_actions(self, actions: torch.Tensor) -> None:
        """Process the raw actions (N, action_dim) of one control step."""
        raise NotImplementedError

    def apply_actions(self) -> None:
        """Set the joint targets for the next physics step."""
        raise NotImplementedError


def shared_action_errors(claims: Iterable[tuple[str, str, Sequence[str]]]) -> list[ConfigError]:
    """Return an error for each joint that two ``claims`` set: (config key, kind of targets, joints) of each term."""
    by_kind: dict[str, list[tuple[str, str, Sequence[str]]]] = {}
    for path, kind, joints in claims:
        by_kind.setdefault(kind, []).append((path.rpartition(".")[2], f"{path}.joint_names", joints))
    named = {kind: f"each joint in one term that sets {kind} targets" for kind in by_kind if kind}
    return [error for kind, expected in named.items() for error in shared_errors(by_kind[kind], expected)]


class ActionManager(ManagerBase):
    """Splits the action vector into one slice for each action term, in the order of the config.

    The field ``delay`` of a term delays its processed actions by physics steps; ``delays`` has the buffers by name.
    """

    kind = "actions"

    def __init__(self, nodes: Terms, env: Env) -> None:
        super().__init__(nodes, env)
        self._action_terms: dict[str, ActionTerm] = {}
        for name, term in self._terms.items():
            if not isinstance(term.func, ActionTerm):
                message = f"'{term.target}' is not the class of an action term"
                raise ConfigError(message, key=term.path, expected="an action term")
            self._action_terms[name] = term.func
            width = getattr(term.func, "action_dim", None)
            if isinstance(width, bool) or not isinstance(width, int) or width < 1:
                message, where = f"action_dim of '{term.target}' is {width!r}", code_place(term.func)
                expected = "a whole number of at least 1, set in __init__"
                raise ConfigError(message, key=term.path, where=where, expected=expected)
            for given in ("raw_actions", "processed_actions"):
                form, source = row_form(env.num_envs, env.device), f"{given} of '{term.target}'"
                require_form(form, getattr(term.func, given, None), source, term.path, term.func)
        driving = [(self._terms[name].path, f) for name, f in self._action_terms.items() if f.drives]
        for error in shared_action_errors((path, f.drives, f.joint_names) for path, f in driving):
            raise error
        action = torch.zeros(self._num_envs, self.total_action_dim, device=env.device)
        self.action = self.buffer("action", action)
        self.prev_action = self.buffer("prev_action", torch.zeros_like(action))
        made = {
            name: made_delay(self._terms[name], term.processed_actions, env, env.prompt_envs)
            for name, term in self._action_terms.items()
        }
        self.delays = self.child("delays", {name: delay for name, delay in made.items() if delay is not None})
        self._is_new = self.number("_is_new", True, saved=False)

    @property
    def action_term_dim(self) -> list[int]:
        """Width of each term."""
        return [term.action_dim for term in self._action_terms.values()]

    @property
    def total_action_dim(self) -> int:
        """Width of the action vector."""
        return sum(self.action_term_dim)

    def get_term(self, name: str) -> ActionTerm:
        """Return the action term with the given name."""
        self.get_term_cfg(name)
        return self._action_terms[name]

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[float]]]:
        """Return the raw actions of one environment by the name of the action term."""
        return [(name, term.raw_actions[env_idx].tolist()) for name, term in self._action_terms.items()]

    def process_action(self, action: torch.Tensor) -> None:
        """Process the raw actions (N, total) of the present control step, without clipping them."""
        if action.shape != self.action.shape:
            raise ValueError(f"the actions have the shape {tuple(action.shape)}, expected {tuple(self.action.shape)}")
        self.prev_action.copy_(self.action)
        self.action.copy_(action)
        self._is_new = True
        start = 0
        for name, term in self._action_terms.items():
            with self._terms[name].blamed():
                term.process_actions(self.action[:, start : start + term.action_dim])
            start += term.action_dim

    def apply_action(self) -> None:
        """Set the joint targets of every action term before a physics step."""
        for name, term in self._action_terms.items():
            if not (self._is_new or name in self.delays or not term.applies_once):
                continue
            with self._terms[name].blamed():
                present = None
                if name in self.delays:
                    present = term.processed_actions.clone()
                    term.processed_actions.copy_(self.delays[name].push(present))
                term.apply_actions()
                if present is not None:
                    term.processed_actions.copy_(present)
        self._is_new = False

    def reset(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Zero the actions of ``env_ids``."""
        self.action.index_fill_(0, env_ids, 0.0)
        self.prev_action.index_fill_(0, env_ids, 0.0)
        self._reset_terms(env_ids)
        for delay in self.delays.values():
            delay.reset(env_ids)
        return {}

    def __str__(self) -> str:
        targets = [self._terms[name].target.rsplit(".", 1)[-1] for name in self._action_terms]
        terms = enumerate(self._action_terms.items())
        rows = [(i, name, term.action_dim, targets[i]) for i, (name, term) in terms]
        return table(f"Actions: {self.total_action_dim}", ("index", "name", "width", "term"), rows)
