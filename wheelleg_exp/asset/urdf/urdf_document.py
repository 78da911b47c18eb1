"""Parse a URDF without a document type, check its numbers, and record which parts of it became part of the MJCF."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from wheelleg_exp.asset.file_limits import LARGEST_TEXT, MOST_ELEMENTS, require_plain_file
from wheelleg_exp.asset.usd.ledger import HUGEST, Ledger
from wheelleg_exp.errors import AssetError

DEEPEST = 60  # nested XML elements


@dataclass(eq=False)
class Element:
    """An XML element with its path in the URDF (``/robot/link[base]/inertial``) and its line, from 1."""

    tag: str
    attributes: dict[str, str]
    line: int
    path: str = ""
    text: str = ""
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> list[Element]:
        """Return the XML element's children with the given tag."""
        return [child for child in self.children if child.tag == tag]

    def first(self, *tags: str) -> Element | None:
        """Return the first child with the given tag, or None; several tags are a path from child to grandchild."""
        found: Element | None = self
        for tag in tags:
            found = next((child for child in found.children if child.tag == tag), None) if found else None
        return found

    def walk(self) -> Iterator[Element]:
        """Yield the XML element and all its descendants, depth first."""
        yield self
        for child in self.children:
            yield from child.walk()


def parse_xml(source: Path, data: bytes) -> Element:
    """Return the root element of an XML file from the bytes of the file."""
    start = len(data) - len(data.lstrip(b" \t\r\n"))
    skipped, parser = data[:start].count(b"\n"), expat.ParserCreate()
    elements: list[Element] = []
    stack: list[tuple[Element, list[str]]] = []  # the XML elements that are still open, with their text so far

    def refuse(message: str, expected: str) -> NoReturn:
        raise AssetError(message, where=f"{source}:{parser.CurrentLineNumber + skipped}", expected=expected)

    def open_element(tag: str, attributes: dict[str, str]) -> None:
        elements.append(Element(tag, attributes, parser.CurrentLineNumber + skipped))
        if stack:
            stack[-1][0].children.append(elements[-1])
        stack.append((elements[-1], []))
        if len(elements) > MOST_ELEMENTS:
            refuse(f"there are more than {MOST_ELEMENTS:,} elements", "one robot")
        if len(stack) > DEEPEST:
            refuse(f"elements are nested more than {DEEPEST} levels deep", "fewer levels")

    def close_element(_: str) -> None:
        element, parts = stack.pop()
        element.text = "".join(parts)

    def add_text(text: str) -> None:
        if stack:
            stack[-1][1].append(text)

    def refuse_doctype(*_: object) -> None:
        # Refuse a document type, because it can define XML entities that grow without limit or read other files.
        refuse("a document type (<!DOCTYPE ...>) is not allowed, because of entities", "a file without it")

    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = open_element, close_element
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = add_text, refuse_doctype
    try:
        parser.Parse(data[start:], True)
    except expat.ExpatError as error:
        where, reason = f"{source}:{error.lineno + skipped}", expat.errors.messages[error.code]
        raise AssetError(f"'{source.name}' is not valid XML: {reason}", where=where) from None
    except (LookupError, ValueError) as error:  # unknown encoding
        raise AssetError(f"'{source.name}' is not valid XML: {error}", where=str(source)) from None
    return elements[0]


SHOWN_TEXT = 60  # characters in a message


@dataclass(eq=False)
class Document:
    """A parsed URDF; ``ledger`` records which elements and attributes the converter has read."""

    source: Path
    root: Element
    ledger: Ledger = field(default_factory=Ledger)

    def fail(self, element: Element, message: str, expected: str | None = None, nearest: str | None = None) -> NoReturn:
        """Raise an AssetError that names an XML element and the element's line."""
        where = f"{self.source}:{element.line}"
        raise AssetError(message, key=element.path, where=where, expected=expected, nearest=nearest)

    def text(self, element: Element, name: str, became: str | None) -> str | None:
        """Return an XML attribute's text or None, and record that the attribute becomes the MJCF part ``became``."""
        value = element.attributes.get(name)
        if value is not None and became is not None:
            self.ledger.mapped(element.path, name, became)
        return value

    def required(self, element: Element, name: str, became: str) -> str:
        """Return an XML attribute's text; a missing or empty attribute raises AssetError."""
        value = self.text(element, name, became)
        if not value:
            self.fail(element, f"<{element.tag}> has no '{name}'", f'{name}="..."')
        return value

    def numbers(self, element: Element, name: str, count: int, became: str) -> tuple[float, ...] | None:
        """Return an XML attribute's numbers, or None if the attribute is missing or blank."""
        text = self.text(element, name, became)
        if text is None or not text.strip():
            return None
        values = tuple(self._parsed(element, name, word) for word in text.split())
        wanted = f"{count} numbers" if count > 1 else "a number"
        if len(values) != count or not all(abs(value) <= HUGEST for value in values):
            self.fail(element, f"'{name}' is '{text[:SHOWN_TEXT]}'", wanted)
        return values

    def number(self, element: Element, name: str, became: str | None, *, endless: bool = False) -> float | None:
        """Return an XML attribute as a number, or None if it is missing or blank; ``endless`` permits infinity."""
        text = self.text(element, name, became)
        if text is None or not text.strip():
            return None
        value = self._parsed(element, name, text.strip())
        if math.isnan(value) or (abs(value) > HUGEST and not endless):
            self.fail(element, f"'{name}' is '{text[:SHOWN_TEXT]}'", "a number that a robot can have")
        return value

    def _parsed(self, element: Element, name: str, word: str) -> float:
        try:
            return float(word.replace("_", "?"))  # Unlike ``float``, the converter rejects an underscore in a number.
        except ValueError:
            return self.fail(element, f"'{name}' is '{word[:SHOWN_TEXT]}'", "a number")


def open_document(source: Path) -> Document:
    """Read a URDF."""
    require_plain_file(source, "a URDF file", LARGEST_TEXT)
    root = parse_xml(source, source.read_bytes())
    if root.tag != "robot":
        message = f"'{source.name}' is not a URDF: its outermost element is <{root.tag}>"
        raise AssetError(message, where=f"{source}:{root.line}", expected="<robot>")
    # The path of an XML element contains its attribute ``name`` if the name is unique among its siblings.
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
    document = Document(source, root)
    for element in document.root.walk():
        values = [PACKAGE.sub("", v) if key == "filename" else v for key, v in element.attributes.items()]
        values.append(element.text)
        if element.tag.startswith("xacro:") or any("${" in value or "$(" in value for value in values):
            document.fail(element, "the file contains unexpanded xacro", "xacro IN -o OUT first")
    return document


PACKAGE = re.compile(r"^(?:file:/{0,2})?\$\(find(?:-pkg-share)? +([^)\s]+) *\)/*")
"""A package in a file name, as in launch files; it means the same as ``package://NAME/``."""


READ = {  # children, by tag
    "robot": {"link", "joint", "material", "mujoco"},
    "link": {"inertial", "visual", "collision"},
    "inertial": {"origin", "mass", "inertia"},
    "visual": {"origin", "geometry", "material"},
    "collision": {"origin", "geometry"},
    "geometry": {"box", "sphere", "cylinder", "capsule", "mesh"},
    "material": {"color"},
    "joint": {"origin", "axis", "parent", "child", "limit", "dynamics", "mimic"},
    "mujoco": {"compiler"},
}

REASONS = {  # by the element's tag
    "gazebo": "Gazebo settings",
    **dict.fromkeys(("transmission", "ros2_control"), "hardware names; the task's configuration defines the drives"),
    "sensor": "sensors are not read; the task's configuration defines the observations",
    "safety_controller": "soft limits of a hardware controller",
    "calibration": "calibration of a hardware encoder",
    "contact": "PyBullet's contact parameters; bodies keep MuJoCo's friction",
    "texture": "textures are not read",
    "specular": "only colours are read",
    "material": "colliders are drawn in one colour",
    "joint_properties": "an old spelling of <dynamics>, which other readers ignore, too",
    **dict.fromkeys(("option", "size"), "MuJoCo settings; the conversion has its own"),
}

ATTRIBUTES = {  # by tag and name
    **dict.fromkeys((("limit", "lower"), ("limit", "upper")), "a joint of this kind has no limits"),
    ("limit", "effort"): "a joint of this kind has no effort limit in the model",
    ("limit", "velocity"): "a joint of this kind has no velocity limit in the model",
    ("axis", "xyz"): "a joint of this kind has no axis",
    ("axis", "rpy"): "an axis is a direction",
    ("robot", "version"): "the version of the format",
    **{("inertia", name): "the link has no mass" for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")},
}


def audit(document: Document, element: Element) -> None:
    """Record every attribute of an XML element, and every element below it, that the converter has not read."""
    for name, value in element.attributes.items():
        if not name.startswith("xmlns") and not document.ledger.knows(element.path, name):
            reason = ATTRIBUTES.get((element.tag, name), "not supported here")
            document.ledger.leave(element.path, name, reason, value)
    for child in element.children:
        if child.tag in READ.get(element.tag, ()):
            audit(document, child)
        else:
            reason = REASONS.get(child.tag, "this part of URDF is not read")
            document.ledger.leave(child.path, child.tag, reason, summary(child))


def summary(element: Element) -> str:
    """Return a summary of an XML element, in one line of text."""
    found = []
    for item in element.walk():
        found += [f"{item.tag} {name}={value}" for name, value in item.attributes.items()]
        found += [f"{item.tag} {text}"] if (text := " ".join(item.text.split())) else []
    return ", ".join(found)[:200]
