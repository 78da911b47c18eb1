"""Reads XML into elements that know their line; document types are refused, and what is too deep or too much."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from wheelleg_exp.asset.sources import MOST_ELEMENTS
from wheelleg_exp.errors import AssetError

DEEPEST = 60  # elements inside each other; a URDF needs eight


@dataclass(eq=False)
class Element:
    """An XML element: ``path`` as people write it (``/robot/link[base]/inertial``), ``line`` from 1."""

    tag: str
    attributes: dict[str, str]
    line: int
    path: str = ""
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> list[Element]:
        """Return the children of one kind."""
        return [child for child in self.children if child.tag == tag]

    def first(self, tag: str) -> Element | None:
        """Return the first child of one kind, None when there is none."""
        return next((child for child in self.children if child.tag == tag), None)

    def walk(self) -> Iterator[Element]:
        """Yield this element and all below, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.walk()


def parse_xml(source: Path, data: bytes) -> Element:
    """Return the outermost element.

    Args:
        source: the file, for messages.
        data: its bytes.

    Raises:
        AssetError: they are no XML, declare a document type or entities, or hold too many elements or too deep ones.
    """
    start = len(data) - len(data.lstrip(b" \t\r\n"))  # blanks before the declaration: common, and harmless
    return _Parser(source, data[:start].count(b"\n")).parse(data[start:])


class _Parser:
    """Expat with a stack; a document type is refused, so that no entity can grow or reach for other files."""

    def __init__(self, source: Path, skipped_lines: int) -> None:
        self.source, self.skipped = source, skipped_lines
        self.stack: list[tuple[Element, list[str]]] = []
        self.count = 0
        self.root: Element | None = None
        self.expat = expat.ParserCreate()
        self.expat.buffer_text = True
        self.expat.StartElementHandler = self._start
        self.expat.EndElementHandler = self._end
        self.expat.CharacterDataHandler = self._text
        self.expat.StartDoctypeDeclHandler = self._doctype

    def parse(self, data: bytes) -> Element:
        """Return the root element; AssetError, with file and line, when the text is no XML."""
        try:
            self.expat.Parse(data, True)
        except expat.ExpatError as error:
            where = f"{self.source}:{error.lineno + self.skipped}"
            reason = expat.errors.messages[error.code]
            raise AssetError(f"'{self.source.name}' is not valid XML: {reason}", where=where) from None
        except (LookupError, ValueError) as error:  # an encoding that nobody knows
            raise AssetError(f"'{self.source.name}' is not valid XML: {error}", where=str(self.source)) from None
        assert self.root is not None
        return self.root

    def _line(self) -> int:
        return self.expat.CurrentLineNumber + self.skipped

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, self._line())
        if self.stack:
            self.stack[-1][0].children.append(element)
        else:
            self.root = element
        self.stack.append((element, []))
        self.count += 1
        if self.count > MOST_ELEMENTS:
            self._refuse(f"there are more than {MOST_ELEMENTS:,} elements", "one robot")
        if len(self.stack) > DEEPEST:
            self._refuse(f"elements stand more than {DEEPEST} deep inside each other", "fewer")

    def _end(self, _: str) -> None:
        element, parts = self.stack.pop()
        element.text = "".join(parts)

    def _text(self, text: str) -> None:
        if self.stack:
            self.stack[-1][1].append(text)

    def _doctype(self, *_: object) -> None:
        self._refuse("a document type (<!DOCTYPE ...>) is not read, because entities are not", "a file without it")

    def _refuse(self, message: str, expected: str) -> NoReturn:
        raise AssetError(message, where=f"{self.source}:{self._line()}", expected=expected)
