"""List tasks, config groups, group options and terms, each with a one-line description."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType

from omegaconf import OmegaConf

from wheelleg_exp.config.composing.config_loader import Loader, chosen_file, hydra_globals
from wheelleg_exp.config.explaining.key_documentation import headline, is_own
from wheelleg_exp.config.tree_lookup import file_text
from wheelleg_exp.constraints import NotEmpty
from wheelleg_exp.errors import ConfigError, not_one_of
from wheelleg_exp.plain_data import yaml_tree
from wheelleg_exp.terms.config_values import constraints_in, describe
from wheelleg_exp.terms.term_binding import INJECTED, RESERVED, TARGET, resolve_target, signature_parameters
from wheelleg_exp.terms.term_errors import type_hints

# ``MODULES`` maps each module of wheelleg_exp.mdp to the config section of the module's terms.
MODULES = {
    "actions": "actions",
    "commands": "commands",
    "observations": "observations",
    "events": "events",
    "rewards": "rewards",
    "terminations": "terminations",
    "curriculums": "curriculum",
    "recorders": "recorders",
}
LIBRARY = "wheelleg_exp.mdp"


@dataclass(frozen=True)
class LibraryTerm:
    """A reward function, an event, or another manager term from ``wheelleg_exp.mdp`` that a config can use.

    ``help`` is the first line of its docstring. ``limits`` maps each bounded parameter to a text with type and bounds.
    """

    section: str
    target: str
    signature: str
    help: str
    limits: dict[str, str]


def library() -> list[LibraryTerm]:
    """Return the public manager terms of the package ``wheelleg_exp.mdp``, grouped by manager."""
    return [term for name, section in MODULES.items() for term in _terms(section, import_module(f"{LIBRARY}.{name}"))]


def _terms(section: str, module: ModuleType) -> Iterator[LibraryTerm]:
    for name, found in vars(module).items():
        is_public = not name.startswith("_") and name == getattr(found, "__name__", None)
        if is_own(module, found) and is_public and is_term(section, found):
            hints = {key: hint for key, hint in type_hints(found).items() if key in signature_parameters(found)}
            bounded = {k: h for k, h in hints.items() if any(not isinstance(c, NotEmpty) for c in constraints_in(h))}
            limits = {key: describe(hint) for key, hint in bounded.items()}
            yield LibraryTerm(section, f"{module.__name__}.{name}", signature_of(found), headline(found), limits)


def is_term(section: str, found: object) -> bool:
    """Return whether an object of a library module is a term: a concrete class, or a function of the environment."""
    if inspect.isclass(found):
        from wheelleg_exp.managers.manager_base import TermBase

        methods = [getattr(found, name) for name in dir(found) if not name.startswith("__")]
        codes = [method.__code__ for method in methods if inspect.isfunction(method)]
        abstract = any(code.co_names == (NotImplementedError.__name__,) for code in codes)
        return issubclass(found, TermBase) and not abstract
    if not inspect.isfunction(found) or next(iter(inspect.signature(found).parameters), None) != INJECTED[0]:
        return False
    # An event function returns None; other functions in ``wheelleg_exp.mdp.events`` are helper functions.
    return section != "events" or type_hints(found).get("return") is type(None)


def signature_of(target: Callable[..., object]) -> str:
    """Return the parameters of a class or function that a config can set, as ``name, name=default``."""
    parts = []
    for name, parameter in signature_parameters(target).items():
        default = parameter.default
        plain = default is None or isinstance(default, (bool, int, float, str))
        shown = repr(default) if plain else "..."
        parts.append(name if default is parameter.empty else f"{name}={shown}")
    return ", ".join(parts)


@dataclass(frozen=True)
class Entry:
    """One option of a config group.

    ``help`` is the first line of the comment at the top of its file, or empty. ``target`` is the ``_target_``, or None.
    """

    group: str
    name: str
    help: str
    file: Path
    target: str | None = None


def groups(config_dirs: Sequence[Path] = ()) -> list[str]:
    """Return the names of all config groups."""
    with hydra_globals():
        return Loader(config_dirs).groups()


def options(group: str, config_dirs: Sequence[Path] = ()) -> list[Entry]:
    """Return the options of a config group, each described by the comment at the top of its file."""
    with hydra_globals():
        loader = Loader(config_dirs)
        _require_group(group, loader.groups())
        return [_entry(loader, group, name) for name in loader.options(group)]


def terms(group: str | None = None, config_dirs: Sequence[Path] = ()) -> list[Entry]:
    """Return the terms of one or all config groups, each described by the docstring of its class or function."""
    with hydra_globals():
        loader = Loader(config_dirs)
        names = loader.groups()
        if group is not None:
            _require_group(group, names)
        chosen = [group] if group is not None else names
        entries = [_entry(loader, name, option) for name in chosen for option in loader.options(name)]
    # Omit config groups such as ``sensor``, whose files have a ``_target_`` but do not define manager terms.
    term_groups = {section.removesuffix("s") for section in RESERVED}
    found = [entry for entry in entries if entry.target is not None]
    described = []
    for entry in (e for e in found if group is not None or e.group.split("/")[0] in term_groups):
        text = ""
        with suppress(ConfigError, ImportError):
            text = headline(resolve_target(str(entry.target), f"{entry.group}.{entry.name}"))
        described.append(replace(entry, help=text or entry.help))
    return described


def _require_group(group: str, names: Sequence[str]) -> None:
    if group not in names:
        raise not_one_of("the given name is not the name of a config group", group, names, key=group)


def _entry(loader: Loader, group: str, name: str) -> Entry:
    config_path = f"{group}/{name}"
    sources = [source for source in loader.get_sources() if source.scheme() == "file"]
    found = [Path(source.path) / f"{config_path}.yaml" for source in sources if source.is_config(config_path)]
    try:
        file = chosen_file(config_path, found)
    except ConfigError:  # If files of the same name conflict, list the first.
        file = found[0]
    except IndexError:
        file = Path(f"{config_path}.yaml")
    try:
        text = file_text(file)
    except (OSError, UnicodeDecodeError):
        text = ""
    return Entry(group, name, leading_comment(text), file, _target(text, name))


def _target(text: str, name: str) -> str | None:
    """Return the target of the term in a file: of the node with the name of the file, or of the only node."""
    try:
        yaml_tree(text)
        content: object = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except Exception:  # A file that is not valid YAML has no ``_target_``.
        return None
    nodes = content if isinstance(content, dict) else {}
    node = nodes.get(name) or (next(iter(nodes.values())) if len(nodes) == 1 else None)
    target = node.get(TARGET) if isinstance(node, dict) else None
    return str(target) if target is not None else None


def leading_comment(text: str) -> str:
    """Return the first line of the comment at the top of a YAML file, below the file's ``# @package`` line."""
    for line in text.splitlines():
        words = line.strip()
        if words and not words.startswith("#"):
            return ""
        comment = words.lstrip("#").strip()
        if comment and not comment.startswith("@"):
            return comment
    return ""
