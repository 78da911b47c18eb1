from dataclasses import dataclass, field
from html.parser import HTMLParser
from urllib.parse import unquote
from xml.etree import ElementTree

BLOCKS = {"p", "pre", "dt", "dd", "div", "td", "th", "h1", "h2", "h3", "li", "figcaption", "summary", "text"}
VOID = {"meta", "link", "img", "br", "hr", "input"}


@dataclass
class Element:
    tag: str
    attributes: dict[str, str]
    text: str = ""
    inside: list[str] = field(default_factory=list)


class Page(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[Element] = []
        self.open: list[Element] = []
        self.wrong: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = Element(tag, {name: value or "" for name, value in attrs}, inside=[e.tag for e in self.open])
        self.elements.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(Element(tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open[-1].tag != tag:
            self.wrong.append(f"</{tag}> after <{self.open[-1].tag if self.open else ''}>")
            return
        self.open.pop()
        if tag in BLOCKS:
            self.handle_data(" ")

    def handle_data(self, data: str) -> None:
        for element in self.open:
            element.text += data

    def all(self, *tags: str) -> list[Element]:
        return [element for element in self.elements if element.tag in tags]

    @property
    def drawings(self) -> list[ElementTree.Element]:
        """The plots: SVG documents in the data URIs of images, in which a browser runs no script."""
        head = "data:image/svg+xml,"
        uris = [element.attributes["src"] for element in self.all("img")]
        return [ElementTree.fromstring(unquote(uri.removeprefix(head))) for uri in uris if uri.startswith(head)]

    def section(self, name: str) -> str:
        (found,) = [element for element in self.elements if element.attributes.get("id") == name]
        return " ".join(found.text.split())

    @property
    def text(self) -> str:
        (body,) = self.all("body")
        return " ".join(body.text.split())
