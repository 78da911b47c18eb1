"""List tasks, groups, options and terms, each with a description of one line."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from omegaconf import OmegaConf

from wheelleg_exp.config.composing.config_loader import Loader, chosen_file, hydra_globals
from wheelleg_exp.config.config_tree import file_text
from wheelleg_exp.config.explaining.key_documentation import headline, is_own
from wheelleg_exp.constraints import NotEmpty
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.plain_data import yaml_tree
from wheelleg_exp.terms.config_values import constraints_in, describe
from wheelleg_exp.terms.term_binding import INJECTED, RESERVED, TARGET, resolve_target, signature_parameters
from wheelleg_exp.terms.term_errors import type_hints

# Module of the library -> the section of its terms.
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
    """A term that a config can select.

    Attributes:
        section: the section of the term.
        target: the dotted name of the term.
        signature: the parameters that a config sets, with their defaults.
        help: the first line of the term's docstring.
        limits: the types and bounds of parameters with bounds, as text, by name.
    """

    section: str
    target: str
    signature: str
    help: str
    limits: dict[str, str]


def library() -> list[LibraryTerm]:
    """Return the public terms, section by section, in the order of the library's modules."""
    return [
        term for module, section in MODULES.items() for term in _terms(section, import_module(f"{LIBRARY}.{module}"))
    ]


def _terms(section: str, module: ModuleType) -> Iterator[LibraryTerm]:
    for name, found in vars(module).items():
        if (
            is_own(module, found)
            and not name.startswith("_")
            and name == getattr(found, "__name__", None)
            and is_term(section, found)
        ):
            target = f"{module.__name__}.{name}"
            yield LibraryTerm(section, target, signature_of(found), headline(found), limits_of(found))


def is_term(section: str, found: Any) -> bool:
    """Return whether an object of a library module is a term, and not a helper.

    A term is a class without abstract methods, or a function whose first parameter is the environment.
    """
    if inspect.isclass(found):
        from wheelleg_exp.managers import TermBase

        return issubclass(found, TermBase) and not _leaves_methods_open(found)
    if not inspect.isfunction(found) or next(iter(inspect.signature(found).parameters), None) != INJECTED[0]:
        return False
    # Events change the environment and return None. Helpers in the same module return a value.
    return section != "events" or type_hints(found).get("return") is type(None)


def _leaves_methods_open(kind: type) -> bool:
    methods = [getattr(kind, name) for name in dir(kind) if not name.startswith("__")]
    codes = [method.__code__ for method in methods if inspect.isfunction(method)]
    return any(code.co_names == (NotImplementedError.__name__,) for code in codes)


def limits_of(target: Any) -> dict[str, str]:
    """Return the types and bounds of a target's parameters that have bounds, as text, by name."""
    hints = {name: hint for name, hint in type_hints(target).items() if name in signature_parameters(target)}
    return {
        name: describe(hint)
        for name, hint in hints.items()
        if any(not isinstance(constraint, NotEmpty) for constraint in constraints_in(hint))
    }


def signature_of(target: Any) -> str:
    """Return the parameters that a config can set, as ``name, name=default``."""
    parts = []
    for name, parameter in signature_parameters(target).items():
        default = parameter.default
        plain = default is None or isinstance(default, (bool, int, float, str))
        shown = repr(default) if plain else "..."
        parts.append(name if default is parameter.empty else f"{name}={shown}")
    return ", ".join(parts)


TASK_GROUP = "task"


@dataclass(frozen=True)
class Entry:
    """One option of a group.

    Attributes:
        group: the config group.
        name: the option, as written in an override.
        help: a description of one line; empty if the file has none.
        file: the YAML file.
        target: the term's target; None if the option is not a term.
    """

    group: str
    name: str
    help: str
    file: Path
    target: str | None = None


def tasks(config_dirs: Sequence[Path] = ()) -> list[Entry]:
    """Return the tasks, each with the comment at the top of its file."""
    return options(TASK_GROUP, config_dirs)


def groups(config_dirs: Sequence[Path] = ()) -> list[str]:
    """Return the config groups."""
    with hydra_globals():
        return Loader(config_dirs).groups()


def options(group: str, config_dirs: Sequence[Path] = ()) -> list[Entry]:
    """Return the options of a group, each with the comment at the top of its file.

    Raises:
        ConfigError: there is no such group.
    """
    with hydra_globals():
        loader = Loader(config_dirs)
        _require_group(group, loader.groups())
        return [_entry(loader, group, name) for name in loader.options(group)]


def terms(group: str | None = None, config_dirs: Sequence[Path] = ()) -> list[Entry]:
    """Return the terms of a group, or of all groups, each with the first line of its target's docstring.

    Raises:
        ConfigError: there is no such group.
    """
    with hydra_globals():
        loader = Loader(config_dirs)
        names = loader.groups()
        if group is not None:
            _require_group(group, names)
        chosen = [group] if group is not None else names
        entries = [_entry(loader, name, option) for name in chosen for option in loader.options(name)]
    found = [entry for entry in entries if entry.target is not None]
    return [_with_docstring(entry) for entry in found if group is not None or _is_term_group(entry.group)]


def _is_term_group(group: str) -> bool:
    # Other groups, such as sensors, also have nodes with targets.
    singular = {section.removesuffix("s") for section in RESERVED}
    return group.split("/")[0] in singular


def _require_group(group: str, names: Sequence[str]) -> None:
    if group not in names:
        raise ConfigError(
            "there is no such config group",
            key=group,
            expected="one of " + ", ".join(names),
            nearest=nearest_name(group, names),
        )


def _entry(loader: Loader, group: str, name: str) -> Entry:
    file = _file(loader, f"{group}/{name}")
    try:
        text = file_text(file)
    except (OSError, UnicodeDecodeError):  # reported when the file is used
        text = ""
    return Entry(group, name, leading_comment(text), file, _target(text, name))


def _file(loader: Loader, config_path: str) -> Path:
    sources = [source for source in loader.get_sources() if source.scheme() == "file"]
    found = [Path(source.path) / f"{config_path}.yaml" for source in sources if source.is_config(config_path)]
    try:
        return chosen_file(config_path, found)
    except ConfigError:  # reported when the file is used
        return found[0]
    except IndexError:
        return Path(f"{config_path}.yaml")


def _target(text: str, name: str) -> str | None:
    """Return the target of the term with the file's own name, or of the file's only node; None without a target."""
    try:
        yaml_tree(text)
        content: Any = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except Exception:  # mistakes in the file are reported when the file is used
        return None
    nodes = content if isinstance(content, dict) else {}
    node = nodes.get(name) or (next(iter(nodes.values())) if len(nodes) == 1 else None)
    target = node.get(TARGET) if isinstance(node, dict) else None
    return str(target) if target is not None else None


def leading_comment(text: str) -> str:
    """Return the first line of the comment at the top of a YAML file, after its package line."""
    for line in text.splitlines():
        words = line.strip()
        if words and not words.startswith("#"):
            return ""
        comment = words.lstrip("#").strip()
        if comment and not comment.startswith("@"):
            return comment
    return ""


def _with_docstring(entry: Entry) -> Entry:
    try:
        target = resolve_target(str(entry.target), f"{entry.group}.{entry.name}")
    except (ConfigError, ImportError):
        return entry
    text = headline(target)
    return Entry(entry.group, entry.name, text or entry.help, entry.file, entry.target)
