"""Explain one key of the config: its value, its sources, its meaning, and its alternatives."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from wheelleg_exp.config import key_slots
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.config.composing.hydra_errors import nearest_path
from wheelleg_exp.config.composing.provenance import Mount, Source, mount_of, option_of
from wheelleg_exp.config.explaining.alternatives import Alternatives, alternatives
from wheelleg_exp.config.explaining.key_documentation import comment_at, file_comment, meaning_of, summary, unit_in
from wheelleg_exp.config.tree_lookup import at, line_table, node_paths, section_at
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path
from wheelleg_exp.terms.term_binding import TARGET


@dataclass(frozen=True)
class Meaning:
    """A text that describes a config key, and the place of this text.

    ``where`` is the file and line of a comment, or the dotted name of a function or class with a docstring. ``about``
    is ``key`` or, if the text describes the whole term of the key, such as a reward, ``term``.
    """

    text: str
    where: str
    about: str = "key"


def meanings(
    tree: Mapping[str, object], keys: Keys, slot: key_slots.Slot | None, sources: Sequence[Source]
) -> tuple[Meaning, ...]:
    """Return the comments and docstrings about a config key, the most specific first."""
    notes: list[Meaning] = []
    # First the comment in the file that Hydra merges last.
    for source in reversed(sources):
        if source.file is None or source.line is None or len(keys) < len(source.package):
            continue
        inside = keys[len(source.package) :]
        # For a config section, ``source.line`` can be the line of a subkey, so look up the section's own line.
        line = line_table(source.file).get(inside, source.line) if inside else 2
        text = comment_at(source.file, line) if inside else file_comment(source.file)
        notes += [Meaning(text, show_file(source.file, line))] if text else []
    if slot is not None and slot.meaning:
        notes.append(Meaning(slot.meaning, slot.reader or "wheelleg"))
    elif text := meaning_of(keys):
        notes.append(Meaning(text, "wheelleg"))
    for length in range(len(keys), 0, -1):
        node = section_at(tree, keys[:length])
        target = key_slots.target_of(node)
        if target is not None:
            notes.append(Meaning(summary(target), str(node[TARGET]), "key" if length == len(keys) else "term"))
            break
    found: dict[str, Meaning] = {}
    for note in notes:
        found.setdefault(note.text, note)
    return tuple(found.values())


def unit_of(notes: Sequence[Meaning], keys: Keys) -> str | None:
    """Return the unit of a key: the first unit that a text about the key names."""
    if keys[-1] in ("weight", TARGET):
        return None
    return next((unit for note in notes if note.about == "key" and (unit := unit_in(note.text))), None)


# Match interpolations of config keys, such as ``${env.num_envs}``, but no resolver calls, such as ``${oc.env:HOME}``.
_REFERENCE = re.compile(r"\$\{([^${}:]+)\}")


@dataclass(frozen=True)
class Reference:
    """One config key that an interpolation refers to; ``raw`` is its own unresolved interpolation, or None."""

    path: str
    value: object
    raw: object
    where: str | None


def references(composed: Composed, keys: Keys, raw: object) -> Iterator[Reference]:
    """Yield all config keys that an interpolation such as ``${env.decimation}`` needs, directly or indirectly."""
    tree = composed.raw_tree
    waiting, seen = [(keys, raw)], {keys}
    while waiting:
        here, text = waiting.pop(0)
        for match in _REFERENCE.finditer(str(text)):
            name = match.group(1).strip()
            dots = len(name) - len(name.lstrip("."))  # ``${.x}`` refers to the key x of the interpolation's section.
            found = (*here[: len(here) - dots], *split_path(name[dots:])) if dots else split_path(name)
            if found in seen:
                continue
            seen.add(found)
            inner = at(tree, found)
            waiting.append((found, inner))
            written = inner if "${" in str(inner) else None
            path = dotted(found)
            yield Reference(path, at(composed.config, found), written, composed.provenance.where(path))


Kind = Literal["value", "term", "section", "group", "not set", "not selected", "removed"]


@dataclass(frozen=True)
class Explanation:
    """The explanation of one key.

    ``value`` is resolved; the default if the config does not set the key. ``raw`` is the unresolved value, or None
    without an interpolation. ``sources`` lists the files and overrides that set or removed the key, oldest first.
    ``mount`` is the group that can set the key, such as ``reward``; ``option`` is its option, such as ``alive``.
    """

    key: str
    kind: Kind
    value: object = None
    raw: object = None
    has_value: bool = False
    unit: str | None = None
    meanings: tuple[Meaning, ...] = ()
    sources: tuple[Source, ...] = ()
    references: tuple[Reference, ...] = ()
    alternatives: Alternatives = field(default_factory=Alternatives)
    mount: Mount | None = None
    option: str | None = None
    children: tuple[tuple[str, object], ...] = ()
    is_read: bool = True


def explain_key(composed: Composed, key: str) -> Explanation:
    """Explain a key or group of a composed config, or a valid key that is not set; ConfigError for an unknown key."""
    tree = composed.raw_tree
    keys, found = split_path(key), composed.mounts
    explained = keys and (
        _removed(composed, tree, keys)
        or _present(composed, tree, keys, found)
        or _group_or_option(key, keys, found)
        or _not_set(tree, keys)
    )
    if not explained:
        depth = next((n for n in range(len(keys), 0, -1) if _is_there(tree, keys[:n])), 0)
        settable = list(key_slots.slots(tree, keys[:depth]))
        node = at(tree, keys[:depth])
        shown = ", ".join(dict.fromkeys([*map(str, node if isinstance(node, Mapping) else ()), *settable]))
        place = f" in {dotted(keys[:depth])}" if depth else ""
        names = [*map(dotted, node_paths(tree)), *(dotted((*keys[:depth], name)) for name in settable)]
        expected = f"one of {shown}{place}" if shown else "a key or a group"
        nearest = nearest_path(key, [*names, *(mount.name for mount in found)])
        message = "there is no such key, and nothing reads one of that name"
        raise ConfigError(message, key=key, expected=expected, nearest=nearest)
    return explained


def _present(composed: Composed, tree: dict[str, object], keys: Keys, found: list[Mount]) -> Explanation | None:
    if not keys or not _is_there(tree, keys):
        return None
    raw, value, slot = at(tree, keys), at(composed.config, keys), key_slots.slot(tree, keys)
    below = composed.provenance.below(dotted(keys))
    sources = _sources(composed, keys) or [s for source in below for s in (*source.shadowed, source)]
    notes = meanings(tree, keys, slot, sources)
    explained = Explanation(
        dotted(keys),
        "value",
        value,
        has_value=True,
        unit=unit_of(notes, keys),
        meanings=notes,
        sources=_sources(composed, keys),
        alternatives=alternatives(tree, keys, slot),
        is_read=slot is not None,
    )
    if isinstance(raw, Mapping):
        node = value if isinstance(value, Mapping) else raw
        mount, option = mount_of(found, keys), None
        package = split_path(mount.package) if mount is not None else ()
        if mount is not None and len(keys) == len(package) + 1:
            option = option_of(mount, keys)
        if option is None and keys != package:
            mount = next((m for m in found if m.name == explained.key), None)
        kind: Kind = "term" if key_slots.section_of(keys) else "section"
        children = tuple((str(name), child) for name, child in node.items())
        return replace(explained, kind=kind, mount=mount, option=option, children=children)
    refers = tuple(references(composed, keys, raw))
    return replace(explained, raw=raw if refers else None, references=refers)


def _is_there(tree: object, keys: Keys) -> bool:
    parent = at(tree, keys[:-1])
    if isinstance(parent, Mapping):
        return keys[-1] in parent
    return isinstance(parent, list) and keys[-1].isdigit() and int(keys[-1]) < len(parent)


def _removed(composed: Composed, tree: dict[str, object], keys: Keys) -> Explanation | None:
    path = dotted(keys)
    term = next((keys[:n] for n in (3, 5) if key_slots.section_of(keys[:n]) is not None), None)
    if term is not None and dotted(term) in composed.removed_terms:
        source = composed.provenance[dotted(term)]
        inside = [s for s in source.shadowed if split_path(s.path)[: len(keys)] == keys]
        notes = meanings(tree, keys, None, source.shadowed)
        return Explanation(path, "removed", sources=(*inside, source), meanings=notes)
    deleted = composed.provenance.deleted_below(path)
    if deleted and not _is_there(tree, keys):
        earlier = tuple(s for source in deleted for s in source.shadowed)
        gone = Source(keys, None, override=deleted[0].override)
        return Explanation(path, "removed", sources=(*earlier, gone), meanings=meanings(tree, keys, None, earlier))
    return None


def _group_or_option(key: str, keys: Keys, found: list[Mount]) -> Explanation | None:
    mount = next((m for m in found if m.name == key), None) or next((m for m in found if m.group == key), None)
    if mount is not None:
        return Explanation(mount.name, "group", value=list(mount.selected), has_value=True, mount=mount)
    mount = mount_of(found, keys)
    option = option_of(mount, keys) if mount is not None else None
    if mount is None or option not in mount.options or option in mount.selected:
        return None
    return Explanation(dotted(keys), "not selected", mount=mount, option=option)


def _not_set(tree: dict[str, object], keys: Keys) -> Explanation | None:
    slot = key_slots.slot(tree, keys)
    named, parent = key_slots.slots(tree, keys[:-1]), at(tree, keys[:-1])
    # In a section that accepts any key, a key that is similar to an existing key is probably a spelling mistake.
    near = nearest_name(keys[-1], map(str, parent)) if isinstance(parent, Mapping) and not named else None
    has_place = bool(named) or (isinstance(parent, Mapping) and near is None)
    if slot is None or not has_place or key_slots.section_of(keys) is not None:
        return None
    if any(not key_slots.slots(tree, keys[: n - 1]) and not _is_there(tree, keys[:n]) for n in range(1, len(keys))):
        return None  # The config lacks the section that would contain the key.
    notes = meanings(tree, keys, slot, ())
    default = None if slot.default is key_slots.REQUIRED else slot.default
    return Explanation(
        dotted(keys),
        "not set",
        value=default,
        has_value=slot.default is not key_slots.REQUIRED,
        unit=unit_of(notes, keys),
        meanings=notes,
        alternatives=alternatives(tree, keys, slot),
    )


def _sources(composed: Composed, keys: Keys) -> tuple[Source, ...]:
    """Return the sources of a config value, oldest first; an element of a list has the sources of the list."""
    for length in range(len(keys), 0, -1):
        source = composed.provenance.get(dotted(keys[:length]))
        if source is not None:
            return (*source.shadowed, source)
    return ()
