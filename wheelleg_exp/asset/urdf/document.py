"""A URDF as elements with readable paths, its numbers checked, and every reading noted."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from wheelleg_exp.asset.sources import LARGEST_TEXT, require_plain_file
from wheelleg_exp.asset.urdf.xml import Element, parse_xml
from wheelleg_exp.asset.usd.attributes import HUGEST
from wheelleg_exp.asset.usd.ledger import Ledger
from wheelleg_exp.errors import AssetError

SHOWN_TEXT = 60  # characters of a value in a message


@dataclass(eq=False)
class Document:
    """A URDF, and the account of what was read of it."""

    source: Path
    root: Element
    ledger: Ledger = field(default_factory=Ledger)

    def fail(self, element: Element, message: str, expected: str | None = None) -> NoReturn:
        """Raise an AssetError that names the element and its line."""
        raise AssetError(message, key=element.path, where=f"{self.source}:{element.line}", expected=expected)

    def text(self, element: Element, name: str, became: str | None) -> str | None:
        """Return an attribute, None when it is absent, and note what it becomes, if anything."""
        value = element.attributes.get(name)
        if value is not None and became is not None:
            self.ledger.mapped(element.path, name, became)
        return value

    def required(self, element: Element, name: str, became: str) -> str:
        """Return an attribute that has to be there and not be empty.

        Raises:
            AssetError: it is not.
        """
        value = self.text(element, name, became)
        if not value:
            self.fail(element, f"<{element.tag}> has no '{name}'", f'{name}="..."')
        return value

    def numbers(self, element: Element, name: str, count: int, became: str) -> tuple[float, ...] | None:
        """Return an attribute's numbers, None when it is absent or blank.

        Raises:
            AssetError: they are not ``count``, or larger than anything a robot has.
        """
        text = self.text(element, name, became)
        if text is None or not text.strip():
            return None
        values = tuple(self._parsed(element, name, word) for word in text.split())
        wanted = f"{count} numbers" if count > 1 else "a number"
        if len(values) != count or not all(abs(value) <= HUGEST for value in values):
            self.fail(element, f"'{name}' is '{text[:SHOWN_TEXT]}'", wanted)
        return values

    def number(self, element: Element, name: str, became: str | None, *, endless: bool = False) -> float | None:
        """Return an attribute's number, None when it is absent or blank; ``endless`` lets infinity pass.

        Raises:
            AssetError: it is no number, NaN, or larger than anything a robot has.
        """
        text = self.text(element, name, became)
        if text is None or not text.strip():
            return None
        value = self._parsed(element, name, text.strip())
        if math.isnan(value) or (abs(value) > HUGEST and not endless):
            self.fail(element, f"'{name}' is '{text[:SHOWN_TEXT]}'", "a number that a robot can have")
        return value

    def _parsed(self, element: Element, name: str, word: str) -> float:
        try:
            return float(word.replace("_", "?"))  # Python reads 1_000, no URDF means it
        except ValueError:
            return self.fail(element, f"'{name}' is '{word[:SHOWN_TEXT]}'", "a number")


def open_document(source: Path) -> Document:
    """Read a URDF.

    Raises:
        AssetError: it cannot be read, is no XML or no URDF, declares a document type or entities, or still holds
            xacro.
    """
    root = parse_xml(source, _bytes(source))
    if root.tag != "robot":
        raise AssetError(
            f"'{source.name}' is not a URDF: its outermost element is <{root.tag}>",
            where=f"{source}:{root.line}",
            expected="<robot>",
        )
    _name_paths(root)
    document = Document(source, root)
    _refuse_xacro(document)
    return document


def _bytes(source: Path) -> bytes:
    require_plain_file(source, "a URDF file", LARGEST_TEXT)
    try:
        return source.read_bytes()
    except OSError as error:
        raise AssetError(f"'{source}' cannot be read: {error.strerror}", expected="a URDF file") from None


def _name_paths(root: Element) -> None:
    """Give each element its path: named by ``name`` where that tells it apart, else by its place."""
    root.path = f"/{root.tag}"
    for element in root.walk():
        named = Counter((child.tag, child.attributes.get("name")) for child in element.children)
        kinds = Counter(child.tag for child in element.children)
        seen: Counter[str] = Counter()
        for child in element.children:
            seen[child.tag] += 1
            name = child.attributes.get("name")
            if name and named[child.tag, name] == 1:
                label = f"[{name}]"
            else:
                label = f"[{seen[child.tag]}]" if kinds[child.tag] > 1 else ""
            child.path = f"{element.path}/{child.tag}{label}"


PACKAGE = re.compile(r"^(?:file:/{0,2})?\$\(find(?:-pkg-share)? +([^)\s]+) *\)/*")
"""How launch files name a package in a file's name; it means what ``package://NAME/`` means."""


def _refuse_xacro(document: Document) -> None:
    """Refuse macros and substitutions that nobody has carried out, but for those that name a file's package."""
    for element in document.root.walk():
        values = [PACKAGE.sub("", v) if key == "filename" else v for key, v in element.attributes.items()]
        values.append(element.text)
        if element.tag.startswith("xacro:") or any("${" in value or "$(" in value for value in values):
            document.fail(element, "the file still holds xacro, which is not carried out here", "xacro IN -o OUT first")
