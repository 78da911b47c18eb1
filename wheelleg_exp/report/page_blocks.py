"""Blocks of a report page: plain values that the templates draw. The templates escape every text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

Tone = Literal["", "good", "warn", "bad"]


@dataclass(frozen=True)
class Card:
    """One key figure: what it is, its value and unit, and what to hold it against."""

    label: str
    value: str
    unit: str = ""
    note: str = ""
    tone: Tone = ""


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: what it says.
        number: whether it stands at the right, in digits of one width.
        code: whether it is something to type or a digest.
        bar: a share in -1 … 1 that is drawn as a bar in place of alone standing digits, or None.
        tone: how to take it.
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
    """A sentence that must not be overlooked: what is missing, damaged or doubtful."""

    text: str
    tone: Tone = "warn"
    kind: str = "note"


@dataclass(frozen=True)
class Code:
    """Lines to be typed, or printed by a program."""

    text: str
    label: str = ""
    kind: str = "code"


@dataclass(frozen=True)
class Facts:
    """Names and what they are."""

    rows: Sequence[tuple[str, str]]
    kind: str = "facts"


@dataclass(frozen=True)
class Table:
    """Rows under headings; the first cell of a row is its heading.

    Attributes:
        title: what it is.
        columns: the headings.
        rows: the cells.
        titled: whether the title is shown; what stands above may say it already.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    titled: bool = True
    kind: str = "table"


@dataclass(frozen=True)
class Plot:
    """A drawing: clean SVG (see ``svg.clean``; empty where words are enough), its title, and what stands below it."""

    svg: str
    title: str
    caption: str = ""


@dataclass(frozen=True)
class Plots:
    """Drawings beside each other where there is room; ``paired`` ones always two in a row, or one."""

    plots: Sequence[Plot]
    paired: bool = False
    kind: str = "plots"


@dataclass(frozen=True)
class Picture:
    """A picture as a data URI, its size in pixels, what it shows, and its caption."""

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
    """Blocks that stand beside each other where there is room."""

    blocks: Sequence[Block]
    kind: str = "beside"


@dataclass(frozen=True)
class More:
    """Blocks that are shown on demand, and always on paper."""

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
