"""Reads the colours of a URDF: of materials by name, and of single shapes."""

from __future__ import annotations

from wheelleg_exp.asset.description import Material, Rgba
from wheelleg_exp.asset.reader.urdf.document import Document
from wheelleg_exp.asset.reader.urdf.xml import Element
from wheelleg_exp.errors import AssetError


class Looks:
    """The colours of a document; ``used`` holds the materials that shapes have asked for."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self._colors: dict[str, Rgba] = {}
        for element in document.root.walk():
            if element.tag == "material":
                self._register(element)
        self.used: dict[tuple[str, Rgba], Material] = {}

    def _register(self, element: Element) -> None:
        """Keep the first colour of each name; a later shape may still bring its own."""
        name, color = element.attributes.get("name"), self._color(element)
        if name and color is not None:
            self._colors.setdefault(name, color)
        if element.first("color") is not None:
            self.document.ledger.mapped(element.path, "name", "material")

    def _color(self, element: Element) -> Rgba | None:
        color = element.first("color")
        try:
            values = self.document.numbers(color, "rgba", 4, "material rgba") if color else None
        except AssetError as error:  # no reason to refuse a robot
            self.document.ledger.leave(element.path, "color", "a colour is four numbers", error.message)
            return None
        if values is None:
            return None
        r, g, b, a = (min(max(value, 0.0), 1.0) for value in values)
        return r, g, b, a

    def of(self, shape: Element) -> tuple[str | None, Rgba | None]:
        """Return the name of the material of a shape, or its own colour when that has no name."""
        element = shape.first("material")
        if element is None:
            return None, None
        name = self.document.text(element, "name", "material") or ""
        color = self._color(element) or self._colors.get(name)
        if color is None:
            if name:
                self.document.ledger.leave(element.path, "name", "a material without colour", name)
            return None, None
        return (self._named(name, color), None) if name else (None, color)

    def _named(self, name: str, color: Rgba) -> str:
        if (name, color) not in self.used:
            same = sum(key[0] == name for key in self.used)
            taken = {material.name for material in self.used.values()}
            free = name if not same else f"{name}_{same + 1}"
            while free in taken:
                free += "_"
            self.used[name, color] = Material(free, color)
        return self.used[name, color].name
