"""What there is: tasks, groups, options and terms, each with one line that says what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf

from wheelleg_exp.config.docstrings import headline
from wheelleg_exp.config.loader import Loader, hydra_globals
from wheelleg_exp.config.replacing import chosen_file
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.terms import RESERVED, TARGET, resolve_target

TASK_GROUP = "task"


@dataclass(frozen=True)
class Entry:
    """One option of a group.

    Attributes:
        group: the config group.
        name: the option, as written in an override.
        help: one line on what it is; empty when nothing says so.
        file: the YAML file.
        target: the term's target, or None for an option that is no term.
    """

    group: str
    name: str
    help: str
    file: Path
    target: str | None = None


def tasks(config_dirs: Sequence[Path] = ()) -> list[Entry]:
    """Return the tasks, each with the comment on top of its file."""
    return options(TASK_GROUP, config_dirs)


def groups(config_dirs: Sequence[Path] = ()) -> list[str]:
    """Return the config groups."""
    with hydra_globals():
        return Loader(config_dirs).groups()


def options(group: str, config_dirs: Sequence[Path] = ()) -> list[Entry]:
    """Return the options of a group, each with the comment on top of its file.

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
    """Tell the groups of terms (reward, event, ...) from others whose nodes have targets as well."""
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
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    return Entry(group, name, leading_comment(text), file, _target(file, name))


def _file(loader: Loader, config_path: str) -> Path:
    sources = [source for source in loader.get_sources() if source.scheme() == "file"]
    found = [Path(source.path) / f"{config_path}.yaml" for source in sources if source.is_config(config_path)]
    try:
        return chosen_file(config_path, found)
    except ConfigError:  # told when the file is used
        return found[0]
    except IndexError:
        return Path(f"{config_path}.yaml")


def _target(file: Path, name: str) -> str | None:
    """Return the target of the term that a file holds under its own name, or of its only node."""
    try:
        content: Any = OmegaConf.to_container(OmegaConf.load(file), resolve=False)
    except (yaml.YAMLError, OSError, ValueError):
        return None
    nodes = content if isinstance(content, dict) else {}
    node = nodes.get(name) or (next(iter(nodes.values())) if len(nodes) == 1 else None)
    target = node.get(TARGET) if isinstance(node, dict) else None
    return str(target) if target is not None else None


def leading_comment(text: str) -> str:
    """Return the first line of the comment on top of a YAML file, after its package line."""
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
