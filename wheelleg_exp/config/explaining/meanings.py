"""Everything that is written about a key: beside it in YAML, in docstrings, in the list of fixed keys."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wheelleg_exp.config import keys as known
from wheelleg_exp.config.composing.provenance import Source
from wheelleg_exp.config.explaining import fixed_keys as fixed
from wheelleg_exp.config.explaining.docstrings import comment_at, file_comment, summary, unit_in
from wheelleg_exp.config.tree import Keys, line_table, show_file
from wheelleg_exp.terms.binding import TARGET


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
