"""List the values that a config key accepts, for ``wheelleg explain`` and for shell completion.

The module does not import torch, because shell completion must be fast. A completion replaces the whole unfinished
argument; if it ends in ``.``, ``=``, ``,``, or ``[``, the user must type the rest.
"""

from __future__ import annotations

import contextlib
import enum
import hashlib
import inspect
import json
import typing
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import wheelleg_exp
from wheelleg_exp.config import key_slots
from wheelleg_exp.config.checking.check_agent import RESOLVERS, known_words
from wheelleg_exp.config.explaining.key_documentation import is_own
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import write_text
from wheelleg_exp.paths import cache_dir, configs_dir
from wheelleg_exp.terms.config_values import limit_words, options_in, type_words
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path
from wheelleg_exp.terms.term_binding import EVENT_MODES, TARGET
from wheelleg_exp.user_exceptions import importing


@dataclass(frozen=True)
class Alternatives:
    """The values that a config key accepts, described as text and, if possible, as a list.

    ``values`` is empty if they cannot be listed. ``keys`` maps each optional subkey that is not set to its default.
    """

    type: str = ""
    limits: tuple[str, ...] = ()
    values: tuple[object, ...] = ()
    has_default: bool = False
    default: object = None
    keys: tuple[tuple[str, object], ...] = ()


def alternatives(tree: Mapping[str, object], keys: Keys, slot: key_slots.Slot | None) -> Alternatives:
    """Return the valid values of a config key; ``keys`` is, for example, ``("env", "num_envs")``."""
    node = at(tree, keys)
    present = node if isinstance(node, Mapping) else None
    below = key_slots.slots(tree, keys) if present is not None else {}
    unset = {n: s for n, s in below.items() if n not in (present or ()) and s.default is not key_slots.REQUIRED}
    absent = tuple((name, _plain(s.default)) for name, s in unset.items())
    if slot is None:
        return Alternatives(keys=absent)
    return Alternatives(
        "" if slot.annotation is Any else type_words(slot.annotation),
        limit_words(slot.annotation),
        tuple(_known_values(tree, keys, slot)),
        slot.default is not key_slots.REQUIRED,
        None if slot.default is key_slots.REQUIRED else _plain(slot.default),
        absent,
    )


def _plain(value: object) -> object:
    """Convert a default value to a type that YAML supports, or to a text."""
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, (bool, int, float, str, Mapping)) else str(value)


def _known_values(tree: Mapping[str, object], keys: Keys, slot: key_slots.Slot) -> Sequence[object]:
    name = keys[-1]
    if name == TARGET:
        return siblings(str(at(tree, keys)))
    if name == "mode" and key_slots.section_of(keys[:-1]) == "events":
        return list(EVENT_MODES)
    if named := key_slots.named_section(key_slots.section_of(keys[:-1]), name):
        return _names(tree, ("env", named))
    if keys[:2] == ("agent", "obs_groups"):
        return _names(tree, ("env", "observations"))
    if name == "name" and slot.reader.endswith(".SceneEntityCfg"):
        return ["robot", *_names(tree, ("env", "scene", "sensors"))]
    if keys[0] == "agent" and slot.reader.startswith("rsl_rl.") and name in RESOLVERS:
        return known_words(name) or []
    return literal_values(slot.annotation)


def literal_values(annotation: object) -> list[object]:
    """Return the values of an annotation that lists its values: a Literal, an enum, or a bool."""
    options = list(options_in(annotation))
    found = [value for option in options for value in _listed(option)]
    return [*found, None] if found and type(None) in options else found


def _listed(option: object) -> list[object]:
    if option is bool:
        return [True, False]
    if inspect.isclass(option) and issubclass(option, enum.Enum):
        return [member.value for member in option]
    return list(typing.get_args(option)) if typing.get_origin(option) is typing.Literal else []


def siblings(target: str) -> list[str]:
    """Return the public functions and classes in the module of a dotted ``_target_`` path."""
    module_name = target.rpartition(".")[0]
    try:
        with importing(module_name):
            module = import_module(module_name)
    except Exception:  # `wheelleg check` reports why the module cannot be imported.
        return []
    return [
        f"{module_name}.{name}"
        for name, found in vars(module).items()
        if not name.startswith("_") and callable(found) and is_own(module, found)
    ]


def _names(tree: Mapping[str, object], keys: Keys) -> list[str]:
    return [str(name) for name, value in section_at(tree, keys).items() if value is not None]


_MOST_VIEWS = 32  # The cache for shell completion contains at most 32 composed configs.


@dataclass(frozen=True)
class CompletionView:
    """The parts of a composed config that shell completion needs.

    ``mounts`` maps each config group to whether it accepts a list of options, as in ``reward@env.rewards=[alive]``.
    """

    tree: dict[str, object]
    mounts: dict[str, bool]
    groups: dict[str, list[str]]


def completion_view(before: Sequence[str], config_dirs: Sequence[Path], primary: str) -> CompletionView | None:
    """Return the parts of a composed config that shell completion needs, from the cache if possible.

    If Hydra rejects the overrides, use only ``task=…``, or none; return None if the primary config cannot be composed.
    """
    folders = [configs_dir(), *(folder.absolute() for folder in config_dirs)]
    stats = {str(path): path.stat() for folder in folders for path in sorted(folder.rglob("*.yaml"))}
    files = [(path, stat.st_mtime_ns, stat.st_size) for path, stat in stats.items()]
    parts = [wheelleg_exp.__version__, list(before), [str(f) for f in folders], primary, files]
    file = cache_dir() / "completion" / f"{hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]}.json"
    with contextlib.suppress(OSError, ValueError, TypeError):
        return CompletionView(**json.loads(file.read_text(encoding="utf-8")))
    from wheelleg_exp.config.composing.compose import compose  # If the cache lacks the config, import Hydra (slow).

    for words in (list(before), [word for word in before if word.startswith("task=")], []):
        try:
            composed = compose(words, primary=primary, config_dirs=config_dirs)
        except WheellegError:
            continue
        groups = {group: composed.loader.options(group) for group in composed.loader.groups()}
        made = CompletionView(composed.raw_tree, {mount.name: mount.several for mount in composed.mounts}, groups)
        with contextlib.suppress(OSError, TypeError, WheellegError):
            write_text(file, json.dumps(asdict(made)))
            stored = sorted(file.parent.glob("*.json"), key=lambda path: path.stat().st_mtime)
            for old in stored[:-_MOST_VIEWS]:
                old.unlink(missing_ok=True)
        return made
    return None


def complete_override(
    word: str, before: Sequence[str], config_dirs: Sequence[Path] = (), primary: str = "train", *, as_key: bool = False
) -> list[str]:
    """Complete an unfinished override, or with ``as_key`` a key or group; ``before`` contains the earlier overrides."""
    seen = completion_view(before, config_dirs, primary)
    if seen is None:
        return []
    if as_key:
        names = [name for name in seen.mounts if name.startswith(word)]
        return list(dict.fromkeys([*_keys(seen.tree, word, removable=True), *names]))
    sign = word[: len(word) - len(word.lstrip("+~"))]
    text = word[len(sign) :]
    if "=" in text:
        name, _, value = text.partition("=")
        options = seen.groups.get(name.partition("@")[0])
        if options is not None:
            if not value.startswith("["):
                found = [option for option in options if option.startswith(value)]
                found = [*found, "["] if seen.mounts.get(name, False) and not value else found
            else:
                head, _, last = value.replace("[", "[,", 1).rpartition(",")
                head = head.replace("[,", "[", 1)
                used = head.lstrip("[").split(",")
                lead = "[" if head == "[" else f"{head},"
                found = [f"{lead}{option}" for option in options if option.startswith(last) and option not in used]
        else:
            found = [leaf for leaf in _leaf_values(seen.tree, split_path(name)) if leaf.startswith(value)]
        return [f"{sign}{name}={text}" for text in found]
    if sign == "~":
        return [sign + found for found in _keys(seen.tree, text, removable=True)]
    groups = [f"{name}=" for name, several in seen.mounts.items() if (several or sign != "+") and name.startswith(text)]
    found = [] if sign == "+" else _keys(seen.tree, text)
    return [sign + name for name in [*groups, *found]]


def _keys(tree: Mapping[str, object], text: str, *, removable: bool = False) -> list[str]:
    """Complete ``text`` to config keys such as ``env.`` and ``seed=``; if ``removable`` is true, add no ``=``."""
    parent: Keys = split_path(text.rpartition(".")[0])
    node = at(tree, parent)
    found = []
    for name, child in node.items() if isinstance(node, Mapping) else ():
        path = dotted((*parent, str(name)))
        open_ended = isinstance(child, Mapping) and bool(child)
        endings = (["", "."] if open_ended else [""]) if removable else (["."] if open_ended else ["="])
        found += [path + ending for ending in endings]
    return [path for path in found if path.startswith(text)]


def _leaf_values(tree: Mapping[str, object], path: Keys) -> list[str]:
    """Suggest values for a config key without importing the function or class of a ``_target_``."""
    now = at(tree, path)
    inside_target = any(TARGET in section_at(tree, path[:n]) for n in range(1, len(path)))
    slot = None if inside_target or path[:1] == ("agent",) else key_slots.slot(tree, path)
    listed = literal_values(slot.annotation) if slot is not None else literal_values(type(now))
    if key_slots.section_of(path) is not None:
        return ["null"]
    present = [] if isinstance(now, Mapping) else [now]
    return list(dict.fromkeys(map(_value_text, [*listed, *present])))


def _value_text(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return "[" + ",".join(map(_value_text, value)) + "]" if isinstance(value, list) else str(value)
