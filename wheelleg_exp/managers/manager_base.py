"""What the managers of terms share: binding, listing, printing and state."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

import torch
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers.environment import Env
from wheelleg_exp.managers.term import Term, TermBase, bind_terms
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.state import Kept


class ManagerBase(Kept):
    """A manager of one section of the config.

    Args:
        nodes: the section's terms by name.
        env: the environment under construction.
        instantiate: whether to make term objects now.
    """

    kind: ClassVar[str]

    def __init__(self, nodes: Mapping[str, Any] | None, env: Env, *, instantiate: bool = True) -> None:
        self._env = env
        self._num_envs = env.num_envs
        self._terms: dict[str, Term] = bind_terms(self.kind, f"env.{self.kind}", nodes, env, instantiate=instantiate)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms, in declaration order."""
        return list(self._terms)

    @property
    def num_envs(self) -> int:
        """Number of environments, N."""
        return self._num_envs

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self._env.device

    @property
    def term_names(self) -> list[str]:
        """Names of the terms, in declaration order, whatever ``active_terms`` sorts them by."""
        return list(self._terms)

    @property
    def bound_terms(self) -> list[Term]:
        """The bound terms, in declaration order."""
        return list(self._terms.values())

    def find_terms(self, name_keys: str | Sequence[str]) -> list[str]:
        """Return the names of the terms that match expressions; ConfigError when one matches none."""
        return match_names(name_keys, list(self._terms), key=f"env.{self.kind}", what="term")[1]

    def set_term_cfg(self, name: str, cfg: Any) -> None:
        """Let a term be what another config says: ``func``, ``params``, the manager's fields."""
        self.get_term_cfg(name).take(cfg)

    def get_term_cfg(self, name: str) -> Term:
        """Return a term with ``func``, ``params`` and the manager's fields, to read and to change.

        Raises:
            ConfigError: there is none of that name.
        """
        if name not in self._terms:
            raise ConfigError(
                f"there is no term '{name}' in env.{self.kind}",
                expected="one of " + (", ".join(self._terms) or "(no terms)"),
                nearest=nearest_name(name, self._terms),
            )
        return self._terms[name]

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the manager and of its terms."""
        return {"terms": {name: term.state_dict() for name, term in self._terms.items()}}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for name, term in self._terms.items():
            term.load_state_dict(saved["terms"][name])

    @property
    def remembers(self) -> bool:
        """Whether a term has something to do at resets."""
        return any(_remembers(term.func) for term in self._terms.values())

    def _reset_terms(self, env_ids: torch.Tensor, but: Collection[str] = ()) -> None:
        for name, term in self._terms.items():
            remembers: Any = term.func
            if name not in but and _remembers(remembers):
                with term.blamed():
                    remembers.reset(env_ids)


def _remembers(func: Any) -> bool:
    return isinstance(func, TermBase) and type(func).reset is not TermBase.reset


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a plain-text table with a title."""
    grid = Table(title=title, title_justify="left", box=SIMPLE, title_style="")
    for column in columns:
        grid.add_column(column)
    for row in rows:
        grid.add_row(*(str(cell) for cell in row))
    console = Console(file=io.StringIO(), width=100, color_system=None)
    console.print(grid)
    stream = console.file
    assert isinstance(stream, io.StringIO)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()).strip("\n")
