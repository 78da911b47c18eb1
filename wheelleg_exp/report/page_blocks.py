"""Blocks of a report page: plain values that the templates draw. The templates escape every text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

Tone = Literal["", "good", "warn", "bad"]


@dataclass(frozen=True)
class Card:
    """One key figure: label, value, unit, and a note for comparison."""

    label: str
    value: str
    unit: str = ""
    note: str = ""
    tone: Tone = ""


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: its text.
        number: whether it is right-aligned with digits of equal width.
        code: whether it is code or a digest.
        bar: a share in -1 … 1 to draw as a bar behind the text, or None.
        tone: good, warn, bad, or neutral.
    """

    text: str
    number: bool = False
    code: bool = False
    bar: float | None = None
    tone: Tone = ""


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    kind: str = "text"


@dataclass(frozen=True)
class Heading:
    """A heading within a section."""

    text: str
    kind: str = "heading"


@dataclass(frozen=True)
class Note:
    """A sentence that must be noticed: something is missing, damaged, or doubtful."""

    text: str
    tone: Tone = "warn"
    kind: str = "note"


@dataclass(frozen=True)
class Code:
    """Lines to type, or a program's output."""

    text: str
    label: str = ""
    kind: str = "code"


@dataclass(frozen=True)
class Facts:
    """Pairs of a name and a value."""

    rows: Sequence[tuple[str, str]]
    kind: str = "facts"


@dataclass(frozen=True)
class Table:
    """Rows under headings; the first cell of a row is its heading.

    ``titled`` says whether the title is shown; a heading above can replace it.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    titled: bool = True
    kind: str = "table"


@dataclass(frozen=True)
class Plot:
    """A drawing: clean SVG (see ``inline_svg.clean``; empty if the caption is enough), its title, and its caption."""

    svg: str
    title: str
    caption: str = ""


@dataclass(frozen=True)
class Plots:
    """Drawings side by side if there is room; ``paired`` drawings always one or two in a row."""

    plots: Sequence[Plot]
    paired: bool = False
    kind: str = "plots"


@dataclass(frozen=True)
class Picture:
    """A picture as a data URI, with its size in pixels, alternative text, and caption."""

    uri: str
    width: int
    height: int
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class Strip:
    """Pictures of one episode, from left to right."""

    title: str
    pictures: Sequence[Picture]
    kind: str = "strip"


@dataclass(frozen=True)
class Beside:
    """Blocks side by side if there is room."""

    blocks: Sequence[Block]
    kind: str = "beside"


@dataclass(frozen=True)
class More:
    """Blocks that are collapsed on the screen and always printed."""

    summary: str
    blocks: Sequence[Block]
    kind: str = "more"


Block = Text | Heading | Note | Code | Facts | Table | Plots | Strip | Beside | More


@dataclass(frozen=True)
class Section:
    """A part of the page under its own heading."""

    id: str
    title: str
    lead: str = ""
    blocks: Sequence[Block] = field(default_factory=tuple)


@dataclass(frozen=True)
class Page:
    """The whole report."""

    run: str
    task: str
    status: str
    tone: Tone
    sentence: str
    cards: Sequence[Card]
    facts: Sequence[tuple[str, str]]
    command: str
    hero: Picture | None
    notes: Sequence[Note]
    sections: Sequence[Section]
    version: str
