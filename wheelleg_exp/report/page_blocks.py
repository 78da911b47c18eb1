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
    number: bool = False  # True aligns the table cell to the right, with digits of equal width.
    code: bool = False  # True shows the table cell in monospace, for example for code or a hash.
    bar: float | None = None  # The table cell shows ``bar``, a number in -1 … 1, as a bar behind its text.
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
    """A block of a report page that shows commands for the user, or the output of a program."""

    text: str
    label: str = ""


@dataclass(frozen=True)
class Facts:
    """A block of a report page that lists pairs of a name and a value."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """A table of a report page; the first cell of each row is the row's heading."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    titled: bool = True  # False hides the table's title, for example if a heading of the page already names the table.


@dataclass(frozen=True)
class Picture:
    """A picture as a data URI, with the size in pixels, the alternative text, and the caption of the picture."""

    uri: str
    width: int
    height: int
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class Plot:
    """A drawing, its title, and its caption; no drawing if the caption is enough."""

    picture: Picture | None
    title: str
    caption: str = ""


@dataclass(frozen=True)
class Plots:
    """Plots of a report page, side by side on a wide screen; with ``paired``, a row has at most two plots."""

    plots: Sequence[Plot]
    paired: bool = False


@dataclass(frozen=True)
class Strip:
    """Pictures of the robot in one episode, shown from left to right."""

    title: str
    pictures: Sequence[Picture]


@dataclass(frozen=True)
class Beside:
    """Blocks of a report page that are side by side on a wide screen."""

    blocks: Sequence[Block]


@dataclass(frozen=True)
class More:
    """Blocks of a report page that a screen shows collapsed and a printer always prints."""

    summary: str
    blocks: Sequence[Block]


Block = Text | Heading | Note | Code | Facts | Table | Plots | Strip | Beside | More


@dataclass(frozen=True)
class Section:
    """A part of a report page with its own heading."""

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
