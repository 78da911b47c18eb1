"""Puts each assumption beside the element that it is about; what belongs to no element stands in the head."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from wheelleg_exp.asset.mjcf.xml import Element

FEW = 6  # a rule that was followed more often is told once, in the head; the report has every place


class Note(Protocol):
    """Where something was assumed, by which rule, and what came of it."""

    @property
    def path(self) -> str:
        """Path in the source."""

    @property
    def rule(self) -> str:
        """The rule."""

    @property
    def value(self) -> str:
        """What came of it."""


class Notes:
    """The notes of a document and the elements of its paths."""

    def __init__(self, notes: Sequence[Note]) -> None:
        self._notes = notes
        self._elements: dict[str, Element] = {}

    def place(self, path: str, element: Element) -> None:
        """Say which element a path became; the first one counts."""
        if path:
            self._elements.setdefault(path, element)

    def write(self) -> list[str]:
        """Give the elements their comments, and return the notes of no element and those of many."""
        rules = Counter(note.rule for note in self._notes)
        many = {rule: count for rule, count in rules.items() if count > FEW}
        head = [f"{rule} ({count} places)" for rule, count in many.items()]
        for note in self._notes:
            if note.rule in many:
                continue
            text = f"{note.rule}: {note.value}" if note.value else note.rule
            element = self._find(note.path)
            if element is None:
                head.append(f"{note.path}: {text}")
            elif text not in element.comment:
                element.comment = f"{element.comment}; {text}" if element.comment else text
        return head

    def _find(self, path: str) -> Element | None:
        """Return the element of a path or of what is above it."""
        while path.strip("/"):
            if path in self._elements:
                return self._elements[path]
            path = path.rpartition("/")[0]
        return None
