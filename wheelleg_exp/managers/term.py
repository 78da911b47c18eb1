"""Binding term nodes to their targets, once, when the environment is built."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import hydra.utils
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.entity import SceneEntityCfg
from wheelleg_exp.managers.face import Env
from wheelleg_exp.sim.state import Kept, Settings, Stateful, made, note_class
from wheelleg_exp.terms import (
    TermNode,
    check_parameters,
    resolve_target,
    split_node,
    walk_targets,
)

_STATEFUL_FIELDS = ("modifiers", "noise")  # their state is saved with the observation's


class TermBase(Stateful):
    """A term with state of its own. Subclasses take ``env``, their parameters and, to draw, ``generator``.

    Its attributes are saved and restored without its help (``sim.state``): tensors always, unless ``settings`` names
    them, everything else once it has changed.
    """

    def reset(self, env_ids: torch.Tensor) -> None:
        """Reset the state of ``env_ids``."""


@dataclass
class Term(Kept):
    """A bound term: ``func(env, **params)`` for functions, ``func(env)`` for term objects.

    Attributes:
        name: the term's name.
        path: its config key.
        target: dotted name of the function or class.
        func: the function, or the term object.
        params: the keyword arguments of every call; empty for term objects.
        fields: the manager's own settings.
        generator: the term's random stream, where it draws.
    """

    name: str
    path: str
    target: str
    func: Callable[..., Any]
    params: dict[str, Any] = field(default_factory=dict)
    fields: dict[str, Any] = field(default_factory=dict)
    generator: torch.Generator | None = None
    settings: Settings | None = field(default=None, init=False)

    def __call__(self, *args: Any) -> Any:
        """Call the term with the environment (and ids); its mistakes are told under its config key."""
        try:
            return self.func(*args, **self.params)
        except ConfigError as error:
            raise _placed(error, self.path) from error
        except Exception as error:
            error.add_note(f"in the term {self.path} ({self.target})")
            raise

    def state_dict(self) -> dict[str, Any]:
        """Return the settings that have changed, and the term object's state."""
        settings = {} if self.settings is None else self.settings.state_dict()
        return {"settings": settings, "object": None if self.stateful is None else self.stateful.state_dict()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        if self.settings is not None:
            self.settings.load_state_dict(saved["settings"])
        if self.stateful is not None:
            self.stateful.load_state_dict(saved["object"])

    @property
    def stateful(self) -> TermBase | None:
        """The term object, or None for a plain function."""
        return self.func if isinstance(self.func, TermBase) else None

    def bound(self) -> None:
        """Note the settings that the config gave: what differs from them later is state."""
        if self.settings is None:
            groups = {"fields": self.fields, "params": self.params}
            self.settings = Settings(groups, self.path, skip=_STATEFUL_FIELDS)


def bind_terms(
    kind: str, section: str, nodes: Mapping[str, Any] | None, env: Env, *, instantiate: bool = True
) -> dict[str, Term]:
    """Bind every term of a section, in declaration order; null terms are skipped.

    Args:
        kind: a key of ``terms.RESERVED``.
        section: config key of the section, such as ``env.rewards``.
        nodes: the composed terms by name.
        env: the environment under construction.
        instantiate: whether to make term objects now; else ``instantiate_term`` does it later.

    Raises:
        ConfigError: a node, a target or a parameter is wrong.
    """
    terms = {
        name: bind_term(kind, split_node(kind, f"{section}.{name}", node), env)
        for name, node in (nodes or {}).items()
        if node is not None
    }
    if instantiate:
        for term in terms.values():
            instantiate_term(term, env)
    return terms


def bind_term(kind: str, node: TermNode, env: Env) -> Term:
    """Bind one node: import its target, hold its parameters against the signature, resolve what they name."""
    target = resolve_target(node.target, node.path)
    check_parameters(kind, node, target)
    params = {name: build(value, f"{node.path}.{name}") for name, value in node.params.items()}
    for name, value in params.items():
        if isinstance(value, SceneEntityCfg):
            value.resolve(env.scene, f"{node.path}.{name}")
    fields = {name: build(value, f"{node.path}.{name}") for name, value in node.fields.items()}
    term = Term(node.name, node.path, node.target, target, params, fields)
    if "generator" in inspect.signature(target).parameters:
        term.generator = env.streams.get(node.path)
        term.params["generator"] = term.generator
    return term


def instantiate_term(term: Term, env: Env) -> None:
    """Make the term object of a class term, and note what every term was made with; functions stay as they are."""
    kind: Any = term.func
    if not inspect.isclass(kind):
        term.bound()
        return
    if not issubclass(kind, TermBase):
        raise ConfigError(
            f"'{term.target}' is not a term class",
            key=term.path,
            expected="a subclass of TermBase or a function",
        )
    try:
        note_again = note_class(kind, term.path)
        term_object: Any = cast(Any, kind)(env=env, **term.params)
    except ConfigError as error:
        raise _placed(error, term.path) from error
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise ConfigError(
            f"'{term.target}' refuses its parameters: {type(error).__name__}: {error}",
            key=term.path,
            expected="the parameters that its documentation names",
        ) from error
    note_again()
    made(term_object, term.path)
    term.func, term.params = term_object, {}
    term.bound()


def _placed(error: ConfigError, path: str) -> ConfigError:
    """Return the error with its key below the term's, unless it names a place of its own."""
    key = error.key
    if key is None or not key.startswith("env."):
        key = f"{path}.{key}" if key else path
    return ConfigError(error.message, key=key, where=error.where, expected=error.expected, nearest=error.nearest)


def build(value: Any, path: str) -> Any:
    """Instantiate the ``_target_`` nodes inside a parameter, after holding them against the allow-list.

    Raises:
        ConfigError: a target is not allowed, or it refuses its arguments.
    """
    targets = list(walk_targets(value, path))
    if not targets:
        return value
    for where, target in targets:
        resolve_target(target, where)
    try:
        return hydra.utils.instantiate(value, _convert_="all")
    except Exception as error:
        cause = error.__cause__ or error
        if isinstance(cause, ConfigError):
            raise _placed(cause, path) from error
        raise ConfigError(str(cause).splitlines()[0], key=path, expected="arguments that the target takes") from error
