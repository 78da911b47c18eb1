"""Bind manager terms to their functions, and define the base class of all managers.

Each term is bound once to its function or class (``_target_``), when the environment is built.
"""

from __future__ import annotations

import copy
import inspect
import io
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from wheelleg_exp.constraints import Terms
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers.return_checks import Form, require_form
from wheelleg_exp.managers.streams import lent
from wheelleg_exp.managers.term_interface import Env, SceneEntityCfg
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.state import Settings, Stateful, adopt
from wheelleg_exp.terms import term_binding
from wheelleg_exp.terms.term_binding import FIELD_TYPES, TARGET, TermNode, read_from, resolve_target
from wheelleg_exp.terms.term_errors import failure, field_errors, nested_errors, parameter_errors, placed
from wheelleg_exp.user_exceptions import ending_as, in_words


class TermBase(Stateful):
    """Base class of terms with state, whose constructors take ``env``, parameters, and, if needed, ``generator``.

    A term declares its state, for example ``self.last = self.buffer("last", torch.zeros(env.num_envs), fill=0.0)``.
    """

    def reset(self, env_ids: torch.Tensor) -> None:
        """Reset the state of ``env_ids``; by default, fill the rows of the buffers that have a ``fill``."""
        self.reset_rows(env_ids)


class OfEnv:
    """Base class with the attributes ``num_envs`` and ``device`` of an object's environment, as in Isaac Lab."""

    _env: Env

    @property
    def num_envs(self) -> int:
        """Number of environments, N."""
        return self._env.num_envs

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self._env.device


class ManagerTermBase(OfEnv, TermBase):
    """A class term in Isaac Lab's style: made by ``(cfg, env)``, called with the environment and the parameters."""

    def __init__(self, cfg: Term, env: Env) -> None:
        self.cfg = cfg
        self._env = env


@dataclass
class Term(Stateful):
    """A manager term; the manager calls a function as ``func(env, **params)``, and an object as ``func(env)``."""

    name: str
    path: str  # the config key of the term
    target: str  # dotted name of the function or class
    func: Callable[..., Any]
    params: dict[str, Any] = field(default_factory=dict)  # keyword arguments of every call; empty for term objects
    fields: dict[str, Any] = field(default_factory=dict)  # the settings that the manager reads
    # The constructor arguments of a term object; ``take_arguments`` applies changes of them.
    arguments: dict[str, Any] = field(default_factory=dict)
    generator: torch.Generator | None = None  # the random stream of the term, if it draws
    settings: Settings | None = field(default=None, init=False)
    form: Form | None = field(default=None, init=False)  # the required form of the return value, if any
    # Whether torch's global generator is this stream while the term runs, for code written for Isaac Lab.
    lends: bool = field(default=False, init=False)
    _has_worked: bool = field(default=False, init=False)
    # ``_make`` makes the object from ``arguments``; it is None if the parameters are passed to each call instead.
    _make: Callable[[], TermBase] | None = field(default=None, init=False)
    _made_with: Mapping[str, object] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.number("params", self.params, saved=False)
        self.number("fields", self.fields, saved=False)
        self.number("arguments", self.arguments, saved=False)
        self.number("_has_worked", False, saved=False)

    def __getattr__(self, name: str) -> object:
        """Return a field of the term's config, such as ``weight``, as an attribute, as in Isaac Lab's configs."""
        if name in FIELD_TYPES:
            return vars(self).get("fields", {}).get(name)
        raise AttributeError(f"a term has no attribute '{name}', only func, params, {', '.join(FIELD_TYPES)}")

    def __setattr__(self, name: str, value: object) -> None:
        if name in FIELD_TYPES:
            self.fields[name] = value
        else:
            super().__setattr__(name, value)

    def __call__(self, *args: object) -> Any:
        """Call the term with the environment (and ids), check the return value, and name the term in its exceptions."""
        with self.blamed():
            value = self.func(*args, **self.params)
        if self.form is not None:
            require_form(self.form, value, f"'{self.target}'", self.path, self.func)
        if not self._has_worked:  # ``__setattr__`` is slow.
            self._has_worked = True
        return value

    def blamed(self) -> AbstractContextManager[None]:
        """Return a context manager that adds a manager term's config key to errors raised in the ``with`` block."""
        return self._lending() if self.lends else _Blamed(self)

    @contextmanager
    def _lending(self) -> Iterator[None]:
        with _Blamed(self), lent(self.generator):
            yield

    def state_dict(self) -> dict[str, object]:
        settings = {} if self.settings is None else self.settings.state_dict()
        return {"settings": settings, "object": None if self.stateful is None else self.stateful.state_dict()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        if self.settings is not None:
            self.settings.load_state_dict(saved["settings"])
        self.take_arguments()
        if self.stateful is not None:
            self.stateful.load_state_dict(saved["object"])

    @property
    def stateful(self) -> TermBase | None:
        """The object of a term whose ``_target_`` is a class; None if ``_target_`` is a function."""
        return self.func if isinstance(self.func, TermBase) else None

    def bound(self) -> None:
        """Note the settings of the term from the config: later differences are state."""
        if self.settings is None:
            params = self.params if self._make is None else self.arguments
            # ``ObservationTerm.state_dict`` saves the state of modifiers and noise.
            skip = ("modifiers", "noise")
            self.settings = Settings({"fields": self.fields, "params": params}, self.path, skip=skip)

    def take_arguments(self) -> None:
        """If constructor arguments of the term's object have changed, update the object, but keep its state."""
        if self._make is not None and self.stateful is not None and self.arguments != self._made_with:
            adopt(self.stateful, self._make())
            self._made_with = copy.deepcopy(self.arguments)


class _Blamed:
    """Adds a term's config key to errors raised in a ``with`` block. A generator would be slower."""

    __slots__ = ("_term",)

    def __init__(self, term: Term) -> None:
        self._term = term

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None:
            term = self._term
            named = failure(error, term.path, term.target, term.func, has_worked=term._has_worked)
            if named is not error:
                raise named from error


def bind_terms(kind: str, section: str, nodes: Terms, env: Env, *, instantiate: bool = True) -> dict[str, Term]:
    """Bind all terms of the config section ``section``, such as ``env.rewards``, which have the kind ``rewards``.

    If ``instantiate`` is False, the caller must later create the terms' objects with ``instantiate_term``.
    """
    terms = {}
    for name, settings in nodes.items():
        node = term_binding.split_node(kind, f"{section}.{name}", settings)
        target = resolve_target(node.target, node.path)
        for error in (*field_errors(kind, node), *parameter_errors(kind, node, target)):
            raise error
        fields = {name: build(value, f"{node.path}.{name}") for name, value in node.fields.items()}
        term = terms[name] = Term(node.name, node.path, node.target, target, {}, fields)
        takes_generator = "generator" in inspect.signature(read_from(target)).parameters
        if takes_generator or term_binding.written_for_isaac_lab(target):
            term.generator, term.lends = env.streams.get(node.path), not takes_generator
        term.params = _params(term, node.params, env)
        term.arguments = copy.deepcopy(node.params) if inspect.isclass(target) else {}
    if instantiate:
        for term in terms.values():
            instantiate_term(term, env)
    return terms


def _params(term: Term, arguments: Mapping[str, object], env: Env) -> dict[str, object]:
    """Return the arguments of a target: with built nodes, resolved entities, and the random stream of the term."""
    params = {name: build(value, f"{term.path}.{name}") for name, value in arguments.items()}
    for name, value in params.items():
        if isinstance(value, SceneEntityCfg):
            value.resolve(env.scene, f"{term.path}.{name}")
    return params if term.generator is None or term.lends else {**params, "generator": term.generator}


def instantiate_term(term: Term, env: Env) -> None:
    """Create the object of a term whose ``func`` is a class, store it as ``func``, and note the term's settings."""
    kind: Any = term.func
    if not inspect.isclass(term.func):
        term.bound()
        return
    if not issubclass(term.func, TermBase):
        expected = "a subclass of TermBase or a function"
        raise ConfigError(f"'{term.target}' is not the class of a term", key=term.path, expected=expected)

    def make() -> TermBase:
        node = TermNode(term.name, term.path, term.target, {}, term.arguments)
        for error in parameter_errors("commands", node, kind):  # The section "commands" reserves no parameter names.
            raise error
        with term.blamed():
            arguments: dict[str, object] = {"cfg": term}
            if not term_binding.takes_cfg(kind):
                arguments = _params(term, term.arguments, env)
            elif (config := term_binding.cfg_class(kind)) and config is read_from(kind):
                # As in Isaac Lab, action and command terms get their parameters as one object ``cfg``.
                arguments = {"cfg": config(**_params(term, term.arguments, env))}
            made: TermBase = kind(env=env, **arguments)
        return made

    if not term_binding.takes_cfg(kind) or read_from(kind) is term_binding.cfg_class(kind):
        term._make, term._made_with = make, copy.deepcopy(term.arguments)
    term.child("func", make())
    if term._make is not None:
        term.params = {}
    term.bound()


def build(value: object, path: str) -> Any:
    """Return a parameter in which each ``_target_`` node is replaced by the object that its target returns."""
    for where, node in term_binding.walk_nodes(value, path):
        if TARGET in node:
            for error in nested_errors(where, node, resolve_target(str(node[TARGET]), where)):
                raise error
    return _built(value, path)


def _built(value: object, path: str) -> Any:
    """Return a deep copy of a parameter in which each ``_target_`` node is replaced by the result of its call."""
    if isinstance(value, (list, tuple)):
        return type(value)(_built(item, f"{path}[{index}]") for index, item in enumerate(value))
    if not isinstance(value, Mapping):
        return copy.deepcopy(value)
    if TARGET not in value:
        return {key: _built(item, f"{path}.{key}") for key, item in value.items()}
    arguments = {key: _built(item, f"{path}.{key}") for key, item in term_binding.target_arguments(value, path).items()}
    try:
        with ending_as(ConfigError):
            return resolve_target(str(value[TARGET]), path)(**arguments)
    except ConfigError as error:
        raise placed(error, path) from error
    except Exception as error:
        message = f"'{value[TARGET]}' refuses its arguments: {in_words(error).splitlines()[0]}"
        raise ConfigError(message, key=path, expected="arguments that the target takes") from error


class ManagerBase(OfEnv, Stateful):
    """Base class of managers, which own the terms of one config section; ``columns`` are the titles of ``_cells``."""

    kind: ClassVar[str]
    columns: ClassVar[tuple[str, ...]] = ()

    def __init__(self, nodes: Terms, env: Env, *, instantiate: bool = True) -> None:
        self._env = env
        self._num_envs = env.num_envs
        terms = bind_terms(self.kind, f"env.{self.kind}", nodes, env, instantiate=instantiate)
        self._terms: dict[str, Term] = self.child("_terms", terms, saved=False)

    @property
    def active_terms(self) -> list[str]:
        """Names of the manager's terms, in the order of the config."""
        return list(self._terms)

    # ``active_terms`` of events is a dictionary, ``term_names`` is not; terms for Isaac Lab read the private name.
    term_names = _term_names = active_terms

    @property
    def bound_terms(self) -> list[Term]:
        """The manager's bound terms, in the order of the config."""
        return list(self._terms.values())

    def find_terms(self, name_keys: str | Sequence[str]) -> list[str]:
        """Return the names of the terms that expressions match; raise ConfigError if an expression matches no term."""
        return match_names(name_keys, list(self._terms), key=f"env.{self.kind}", what="term")[1]

    def set_term_cfg(self, name: str, cfg: Term) -> None:
        """Copy ``func``, ``params``, and the fields (such as ``weight``) of ``cfg`` to the term ``name``."""
        term = self.get_term_cfg(name)
        if cfg is term:
            return
        if getattr(cfg, "func", None) is not None:
            term.func = cfg.func
        if getattr(cfg, "params", None) is not None:
            term.params = dict(cfg.params)
        for setting in term.fields:
            term.fields[setting] = getattr(cfg, setting, term.fields[setting])

    def get_term_cfg(self, name: str) -> Term:
        """Return a term, whose ``func``, ``params``, and fields (such as ``weight``) can be read and changed."""
        if name not in self._terms:
            message, nearest = f"there is no term '{name}' in env.{self.kind}", nearest_name(name, self._terms)
            raise ConfigError(message, expected="one of " + (", ".join(self._terms) or "(no terms)"), nearest=nearest)
        return self._terms[name]

    def state_dict(self) -> dict[str, object]:
        return {"terms": {name: term.state_dict() for name, term in self._terms.items()}, **super().state_dict()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        for name, term in self._terms.items():
            term.load_state_dict(saved["terms"][name])
        super().load_state_dict(saved)

    def _reset_terms(self, env_ids: torch.Tensor, but: Collection[str] = ()) -> None:
        for name, term in self._terms.items():
            if name not in but and term.stateful is not None:
                with term.blamed():
                    term.stateful.reset(env_ids)

    def _cells(self, term: Term) -> tuple[object, ...]:  # noqa: ARG002
        """Return the cells of one term for the ``columns`` that a manager adds to its printed table of terms."""
        return ()

    def __str__(self) -> str:
        cells = [(t.name, *self._cells(t), t.target.rsplit(".", 1)[-1]) for t in self.bound_terms]
        rows = [(i, *row) for i, row in enumerate(cells)]
        return table(f"{self.kind.capitalize()}: {len(rows)}", ("index", "name", *self.columns, "term"), rows)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table with a title as plain text."""
    grid = Table(title=title, title_justify="left", box=SIMPLE, title_style="")
    for column in columns:
        grid.add_column(column)
    for row in rows:
        grid.add_row(*(str(cell) for cell in row))
    text = io.StringIO()
    Console(file=text, width=100, color_system=None).print(grid)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()).strip("\n")
