"""What could come next in an override or a key that is being typed; imports no torch, because a TAB must be quick.

A candidate is the whole word. One that ends in ``.``, ``=``, ``,`` or ``[`` is not complete.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import wheelleg_exp
from wheelleg_exp.config import keys as known
from wheelleg_exp.config.explaining.alternatives import literal_values
from wheelleg_exp.config.tree import Keys, dotted, split_path
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.paths import cache_dir, configs_dir
from wheelleg_exp.terms.binding import TARGET

_KEPT = 32  # views before the oldest are dropped


@dataclass(frozen=True)
class View:
    """A composed config, as far as completion is concerned.

    Attributes:
        tree: the raw tree.
        mounts: the groups by the names that overrides use, each with whether it takes a list.
        groups: every group with its options.
    """

    tree: dict[str, Any]
    mounts: dict[str, bool]
    groups: dict[str, list[str]]


def view(before: Sequence[str], config_dirs: Sequence[Path], primary: str) -> View | None:
    """Return the view of what some overrides compose; of fewer of them where they do not; None when nothing does."""
    file = cache_dir() / "completion" / f"{_digest(before, config_dirs, primary)}.json"
    with contextlib.suppress(OSError, ValueError, TypeError):
        return View(**json.loads(file.read_text(encoding="utf-8")))
    made = _make(before, config_dirs, primary)
    if made is not None:
        with contextlib.suppress(OSError, TypeError):
            _keep(file, json.dumps(asdict(made)))
    return made


def _digest(before: Sequence[str], config_dirs: Sequence[Path], primary: str) -> str:
    """Return what a view depends on: the words, and names, sizes and times of all config files."""
    folders = [configs_dir(), *(folder.absolute() for folder in config_dirs)]
    files = [
        (str(path), (s := path.stat()).st_mtime_ns, s.st_size) for f in folders for path in sorted(f.rglob("*.yaml"))
    ]
    parts = [wheelleg_exp.__version__, list(before), [str(f) for f in folders], primary, files]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def _make(before: Sequence[str], config_dirs: Sequence[Path], primary: str) -> View | None:
    from wheelleg_exp.config.composing.compose import compose

    for words in (list(before), [word for word in before if word.startswith("task=")], []):
        try:
            composed = compose(words, primary=primary, config_dirs=config_dirs)
        except WheellegError:
            continue
        groups = {group: composed.loader.options(group) for group in composed.loader.groups()}
        return View(composed.raw_tree, {mount.name: mount.several for mount in composed.mounts}, groups)
    return None


def _keep(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(file)
    kept = sorted(file.parent.glob("*.json"), key=lambda path: path.stat().st_mtime)
    for old in kept[:-_KEPT]:
        old.unlink(missing_ok=True)


def overrides(word: str, before: Sequence[str], config_dirs: Sequence[Path] = (), primary: str = "train") -> list[str]:
    """Return the overrides that begin with ``word``.

    Args:
        word: what is typed.
        before: the other overrides on the line; those that do not compose yet are left out.
        config_dirs: the user's config folders.
        primary: the primary config.
    """
    seen = view(before, config_dirs, primary)
    if seen is None:
        return []
    sign = word[: len(word) - len(word.lstrip("+~"))]
    text = word[len(sign) :]
    if "=" in text:
        name, _, value = text.partition("=")
        return [f"{sign}{name}={found}" for found in _values(seen, name, value)]
    if sign == "~":
        return [sign + found for found in _keys(seen.tree, text, removable=True)]
    groups = [f"{name}=" for name, several in seen.mounts.items() if (several or sign != "+") and name.startswith(text)]
    found = [] if sign == "+" else _keys(seen.tree, text)
    return [sign + name for name in [*groups, *found]]


def keys(word: str, before: Sequence[str], config_dirs: Sequence[Path] = (), primary: str = "train") -> list[str]:
    """Return the keys that begin with ``word``, sections and leaves alike, and the groups."""
    seen = view(before, config_dirs, primary)
    if seen is None:
        return []
    names = [name for name in seen.mounts if name.startswith(word)]
    return list(dict.fromkeys([*_keys(seen.tree, word, removable=True), *names]))


def _keys(tree: Mapping[str, Any], text: str, *, removable: bool = False) -> list[str]:
    """Return the next level of keys: ``env.``, ``env.decimation=``; where they end there, also without a sign."""
    parent: Keys = split_path(text.rpartition(".")[0])
    node = known.at(tree, parent)
    found = []
    for name, child in node.items() if isinstance(node, Mapping) else ():
        path = dotted((*parent, str(name)))
        open_ended = isinstance(child, Mapping) and bool(child)
        endings = (["", "."] if open_ended else [""]) if removable else (["."] if open_ended else ["="])
        found += [path + ending for ending in endings]
    return [path for path in found if path.startswith(text)]


def _values(seen: View, name: str, value: str) -> list[str]:
    options = seen.groups.get(name.partition("@")[0])
    if options is not None:
        return _selections(options, value, several=seen.mounts.get(name, False))
    return [found for found in _leaf_values(seen.tree, split_path(name)) if found.startswith(value)]


def _selections(options: Sequence[str], value: str, *, several: bool) -> list[str]:
    """Return option names; within ``[a,b`` the next one."""
    if not value.startswith("["):
        found = [option for option in options if option.startswith(value)]
        return [*found, "["] if several and not value else found
    head, _, last = value.replace("[", "[,", 1).rpartition(",")
    head = head.replace("[,", "[", 1)
    used = head.lstrip("[").split(",")
    lead = "[" if head == "[" else f"{head},"
    return [f"{lead}{option}" for option in options if option.startswith(last) and option not in used]


def _leaf_values(tree: Mapping[str, Any], path: Keys) -> list[str]:
    """Return the values that are known without importing a term: literals, true and false, the value as it is."""
    now = known.at(tree, path)
    inside_target = any(_has_target(known.at(tree, path[:n])) for n in range(1, len(path)))
    slot = None if inside_target or path[:1] == ("agent",) else known.slot(tree, path)
    listed = literal_values(slot.annotation) if slot is not None else literal_values(type(now))
    if known.section_of(path) is not None:
        return ["null"]
    return list(dict.fromkeys([*map(_text, listed), *([_text(now)] if not isinstance(now, Mapping) else [])]))


def _has_target(node: Any) -> bool:
    return isinstance(node, Mapping) and TARGET in node


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return "[" + ",".join(map(_text, value)) + "]" if isinstance(value, list) else str(value)
