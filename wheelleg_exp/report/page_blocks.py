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
    """One cell of a table."""

    text: str
    number: bool = False  # whether the cell is aligned to the right, with digits of equal width
    code: bool = False  # marks code and digests
    bar: float | None = None  # a number in -1 … 1 that is drawn as a bar behind the text
    tone: Tone = ""


@dataclass(frozen=True)
class Text:
    """A paragraph of text."""

    text: str


@dataclass(frozen=True)
class Heading:
    """A heading within a section."""

    text: str


@dataclass(frozen=True)
class Note:
    """A sentence that must be noticed: something is missing, damaged, or doubtful."""

    text: str
    tone: Tone = "warn"


@dataclass(frozen=True)
class Code:
    """A block of a report page with commands for the user, or with the output of a program."""

    text: str
    label: str = ""


@dataclass(frozen=True)
class Facts:
    """A block of a report page with pairs of a name and a value."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """A table of a report page; the first cell of a row is the heading of the row."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    titled: bool = True  # whether the page shows the table's title; false if a heading replaces the title


@dataclass(frozen=True)
class Plot:
    """A drawing: clean SVG (see ``inline_svg.clean``; empty if the caption is enough), its title, and its caption."""

    svg: str
    title: str
    caption: str = ""


@dataclass(frozen=True)
class Plots:
    """Drawings of a report page, side by side on a wide screen; ``paired`` drawings are one or two in a row."""

    plots: Sequence[Plot]
    paired: bool = False


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


@dataclass(frozen=True)
class Beside:
    """Blocks of a report page that are side by side on a wide screen."""

    blocks: Sequence[Block]


@dataclass(frozen=True)
class More:
    """Blocks of a report page that are collapsed on the screen and always printed."""

    summary: str
    blocks: Sequence[Block]


Block = Text | Heading | Note | Code | Facts | Table | Plots | Strip | Beside | More


@dataclass(frozen=True)
class Section:
    """A part of a report page under its own heading."""

    id: str
    title: str
    lead: str = ""
    blocks: Sequence[Block] = field(default_factory=tuple)


@dataclass(frozen=True)
class Page:
    """The content of a whole report page."""

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
