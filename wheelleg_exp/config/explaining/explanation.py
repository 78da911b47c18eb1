"""Explain one key of the config: its value, its sources, its meaning, and its alternatives."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from wheelleg_exp.config import key_slots as known
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.config.composing.hydra_errors import nearest_path
from wheelleg_exp.config.composing.provenance import Mount, Source, mount_of, option_of
from wheelleg_exp.config.config_tree import line_table, node_paths
from wheelleg_exp.config.explaining import key_documentation as fixed
from wheelleg_exp.config.explaining.alternatives import Alternatives, alternatives
from wheelleg_exp.config.explaining.key_documentation import comment_at, file_comment, summary, unit_in
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path
from wheelleg_exp.terms.term_binding import TARGET


@dataclass(frozen=True)
class Meaning:
    """One text about a key, and where it stands.

    Attributes:
        text: the text.
        where: ``file:line``, or the dotted name of what the docstring belongs to.
        about: ``key``, or ``term`` when it describes the whole term around the key.
    """

    text: str
    where: str
    about: str = "key"


def meanings(
    tree: Mapping[str, Any], keys: Keys, slot: known.Slot | None, sources: Sequence[Source]
) -> tuple[Meaning, ...]:
    """Return what is written about a key, the nearest first.

    Args:
        tree: the raw tree.
        keys: the key.
        slot: what may stand there.
        sources: who wrote it, oldest first.
    """
    found: dict[str, Meaning] = {}
    for note in (*_comments(keys, sources), *_docstrings(tree, keys, slot)):
        found.setdefault(note.text, note)
    return tuple(found.values())


def unit_of(notes: Sequence[Meaning], keys: Keys) -> str | None:
    """Return the unit that the first of the texts about the key itself names."""
    if keys[-1] in ("weight", TARGET):
        return None
    return next((unit for note in notes if note.about == "key" and (unit := unit_in(note.text))), None)


def _comments(keys: Keys, sources: Sequence[Source]) -> Iterator[Meaning]:
    """Yield what the files that wrote the key, the last first, say on its line or above it."""
    for source in reversed(sources):
        if source.file is None or source.line is None or len(keys) < len(source.package):
            continue
        inside = keys[len(source.package) :]
        if inside:
            # Of a mapping, its own line rather than its first leaf's; of a list's element, the list's.
            line = line_table(source.file).get(inside, source.line)
            text = comment_at(source.file, line)
        else:
            line, text = 2, file_comment(source.file)
        if text:
            yield Meaning(text, show_file(source.file, line))


def _docstrings(tree: Mapping[str, Any], keys: Keys, slot: known.Slot | None) -> Iterator[Meaning]:
    if slot is not None and slot.meaning:
        yield Meaning(slot.meaning, slot.reader or "wheelleg")
    elif text := fixed.meaning_of(keys):
        yield Meaning(text, "wheelleg")
    for length in range(len(keys), 0, -1):
        node = known.at(tree, keys[:length])
        target = known.target_of(node)
        if target is not None:
            about = "key" if length == len(keys) else "term"
            yield Meaning(summary(target), str(node[TARGET]), about)
            return


# The inner part of a reference to a key; with a colon it calls a resolver instead.
_REFERENCE = re.compile(r"\$\{([^${}:]+)\}")


@dataclass(frozen=True)
class Reference:
    """One key that an interpolation reads.

    Attributes:
        path: the key.
        value: its value, resolved.
        raw: its value as written, where that is an interpolation itself.
        where: who set it.
    """

    path: str
    value: Any
    raw: Any
    where: str | None


def references(composed: Composed, keys: Keys, raw: Any) -> Iterator[Reference]:
    """Yield what a raw value refers to, and what those refer to in turn."""
    tree = composed.raw_tree
    waiting, seen = [(keys, raw)], {keys}
    while waiting:
        here, text = waiting.pop(0)
        for match in _REFERENCE.finditer(str(text)):
            found = _absolute(match.group(1).strip(), here)
            if found in seen:
                continue
            seen.add(found)
            inner = known.at(tree, found)
            waiting.append((found, inner))
            written = inner if "${" in str(inner) else None
            yield Reference(
                dotted(found), known.at(composed.config, found), written, composed.provenance.where(dotted(found))
            )


def _absolute(text: str, keys: Keys) -> Keys:
    """Return the keys that a reference at ``keys`` names: one leading dot is the same mapping, two the one above."""
    dots = len(text) - len(text.lstrip("."))
    return split_path(text) if dots == 0 else (*keys[: len(keys) - dots], *split_path(text[dots:]))


Kind = Literal["value", "term", "section", "group", "not set", "not selected", "removed"]


@dataclass(frozen=True)
class Explanation:
    """What there is to say about one key.

    Attributes:
        key: the key.
        kind: what it is.
        value: the value in force, resolved; of a key that is not set, the default.
        raw: the value as written, where it has ``${...}``, else None.
        has_value: whether ``value`` says anything.
        unit: its unit, where one is known.
        meanings: what is written about it, the nearest first.
        sources: who wrote it, oldest first; the last is in force (or removed it).
        references: what ``${...}`` leads to, in order.
        alternatives: what else could stand there.
        mount: the group that the key is, mounts, or comes from.
        option: of a term, the group's option that brings it.
        children: the keys below it, with their values in force.
        is_read: whether anything reads such a key.
    """

    key: str
    kind: Kind
    value: Any = None
    raw: Any = None
    has_value: bool = False
    unit: str | None = None
    meanings: tuple[Meaning, ...] = ()
    sources: tuple[Source, ...] = ()
    references: tuple[Reference, ...] = ()
    alternatives: Alternatives = field(default_factory=Alternatives)
    mount: Mount | None = None
    option: str | None = None
    children: tuple[tuple[str, Any], ...] = ()
    is_read: bool = True


def explain_key(composed: Composed, key: str) -> Explanation:
    """Explain a key of a composed config, or a group.

    Args:
        composed: the config.
        key: a leaf, term or section, set or not; or a group such as ``robot`` or ``reward@env.rewards``.

    Raises:
        ConfigError: there is no such key and nothing reads one of that name, with the nearest there is.
    """
    tree = composed.raw_tree
    keys, found = split_path(key), composed.mounts
    explained = keys and (
        _removed(composed, tree, keys)
        or _present(composed, tree, keys, found)
        or _group(key, found)
        or _not_selected(keys, found)
        or _not_set(tree, keys)
    )
    if not explained:
        raise _unknown(tree, key, found)
    return explained


def _present(composed: Composed, tree: dict[str, Any], keys: Keys, found: list[Mount]) -> Explanation | None:
    if not keys or not _is_there(tree, keys):
        return None
    raw, value, slot = known.at(tree, keys), known.at(composed.config, keys), known.slot(tree, keys)
    notes = meanings(tree, keys, slot, _all_sources(composed, keys))
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
        return _with_children(explained, keys, value if isinstance(value, Mapping) else raw, found)
    refers = tuple(references(composed, keys, raw))
    return replace(explained, raw=raw if refers else None, references=refers)


def _with_children(explained: Explanation, keys: Keys, node: Mapping[str, Any], found: list[Mount]) -> Explanation:
    """Turn the explanation of a value into that of a term or a section."""
    mount, option = mount_of(found, keys), None
    package = split_path(mount.package) if mount is not None else ()
    if mount is not None and len(keys) == len(package) + 1:
        option = option_of(mount, keys)
    if option is None and keys != package:
        mount = next((m for m in found if m.name == explained.key), None)
    kind: Kind = "term" if known.section_of(keys) else "section"
    children = tuple((str(name), child) for name, child in node.items())
    return replace(explained, kind=kind, mount=mount, option=option, children=children)


def _is_there(tree: Any, keys: Keys) -> bool:
    parent = known.at(tree, keys[:-1])
    if isinstance(parent, Mapping):
        return keys[-1] in parent
    return isinstance(parent, list) and keys[-1].isdigit() and int(keys[-1]) < len(parent)


def _removed(composed: Composed, tree: dict[str, Any], keys: Keys) -> Explanation | None:
    """Explain a term that was set to null, anything inside it, and what an override deleted."""
    path = dotted(keys)
    term = known.term_keys(keys)
    if term is not None and dotted(term) in composed.removed_terms:
        source = composed.provenance[dotted(term)]
        inside = [s for s in source.shadowed if split_path(s.path)[: len(keys)] == keys]
        return Explanation(
            path, "removed", sources=(*inside, source), meanings=meanings(tree, keys, None, source.shadowed)
        )
    deleted = {p: s for p, s in composed.provenance.deleted.items() if split_path(p)[: len(keys)] == keys}
    if deleted and not _is_there(tree, keys):
        first = next(iter(deleted.values()))
        earlier = tuple(s for source in deleted.values() for s in source.shadowed)
        gone = Source(path, None, override=first.override)
        return Explanation(path, "removed", sources=(*earlier, gone), meanings=meanings(tree, keys, None, earlier))
    return None


def _group(key: str, found: list[Mount]) -> Explanation | None:
    mount = next((m for m in found if m.name == key), None) or next((m for m in found if m.group == key), None)
    if mount is None:
        return None
    return Explanation(mount.name, "group", value=list(mount.selected), has_value=True, mount=mount)


def _not_selected(keys: Keys, found: list[Mount]) -> Explanation | None:
    mount = mount_of(found, keys)
    option = option_of(mount, keys) if mount is not None else None
    if mount is None or option not in mount.options or option in mount.selected:
        return None
    return Explanation(dotted(keys), "not selected", mount=mount, option=option)


def _not_set(tree: dict[str, Any], keys: Keys) -> Explanation | None:
    slot = known.slot(tree, keys)
    has_place = isinstance(known.at(tree, keys[:-1]), Mapping) or bool(known.slots(tree, keys[:-1]))
    if slot is None or not has_place or known.section_of(keys) is not None or _is_slip(tree, keys):
        return None
    if any(not known.slots(tree, keys[: n - 1]) and not _is_there(tree, keys[:n]) for n in range(1, len(keys))):
        return None  # below a name that may be any, and that nobody has given
    notes = meanings(tree, keys, slot, ())
    default = None if slot.default is known.REQUIRED else slot.default
    return Explanation(
        dotted(keys),
        "not set",
        value=default,
        has_value=slot.default is not known.REQUIRED,
        unit=unit_of(notes, keys),
        meanings=notes,
        alternatives=alternatives(tree, keys, slot),
    )


def _is_slip(tree: dict[str, Any], keys: Keys) -> bool:
    """Return whether a key of a mapping that takes any name is nearly one that is there."""
    node = known.at(tree, keys[:-1])
    named = known.slots(tree, keys[:-1])
    return not named and isinstance(node, Mapping) and nearest_name(keys[-1], map(str, node)) is not None


def _sources(composed: Composed, keys: Keys) -> tuple[Source, ...]:
    """Return the writers of one leaf, oldest first; of a list's element, the writers of the list."""
    for length in range(len(keys), 0, -1):
        source = composed.provenance.get(dotted(keys[:length]))
        if source is not None:
            return (*source.shadowed, source)
    return ()


def _all_sources(composed: Composed, keys: Keys) -> tuple[Source, ...]:
    leaf = _sources(composed, keys)
    return leaf or tuple(s for source in composed.provenance.below(dotted(keys)) for s in (*source.shadowed, source))


def _unknown(tree: dict[str, Any], key: str, found: Sequence[Mount]) -> ConfigError:
    keys = split_path(key)
    depth = next((n for n in range(len(keys), 0, -1) if _is_there(tree, keys[:n])), 0)
    settable = list(known.slots(tree, keys[:depth]))
    node = known.at(tree, keys[:depth])
    shown = ", ".join(dict.fromkeys([*map(str, node if isinstance(node, Mapping) else ()), *settable]))
    place = f" in {dotted(keys[:depth])}" if depth else ""
    names = [*map(dotted, node_paths(tree)), *(dotted((*keys[:depth], name)) for name in settable)]
    return ConfigError(
        "there is no such key, and nothing reads one of that name",
        key=key,
        expected=f"one of {shown}{place}" if shown else "a key or a group",
        nearest=nearest_path(key, [*names, *(mount.name for mount in found)]),
    )
