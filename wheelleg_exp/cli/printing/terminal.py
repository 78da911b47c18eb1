"""Write text and tables to the terminal, or to a pipe.

Tables and blocks of text fit the screen: the terminal's width, otherwise 100 columns. A reader of standard output
or standard error can disappear; then the command continues, and its output is dropped.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from wheelleg_exp.errors import printable


class LastingStream:
    """A text stream that takes what is written when nobody reads it any more.

    Args:
        stream: where text goes.
        losses: the errors that mean that nobody reads it.
        styled: whether the text may hold what a terminal obeys; otherwise that is shown by its codes.
    """

    def __init__(self, stream: Any, *losses: type[OSError], styled: bool = False) -> None:
        self._stream, self._losses, self._styled = stream, losses, styled

    def styled(self) -> LastingStream:
        """Return the stream for colours and moving lines; who writes to it looks after the texts of others itself."""
        return LastingStream(self._stream, *self._losses, styled=True)

    def write(self, text: str) -> int:
        """Write a text, and return its length."""
        try:
            self._write(text if self._styled else printable(text))
        except self._losses:
            self._let_go()
        return len(text)

    def _write(self, text: str) -> None:
        """Write a text; what the stream's encoding cannot show, as ASCII cannot show °, becomes a question mark."""
        try:
            self._stream.write(text)
        except UnicodeEncodeError as error:
            self._stream.write(text.encode(error.encoding, "replace").decode(error.encoding))

    def flush(self) -> None:
        """Pass on what has been written."""
        try:
            self._stream.flush()
        except self._losses:
            self._let_go()

    def _let_go(self) -> None:
        """Point the stream at nothing, so that the interpreter's last flush does not complain."""
        with suppress(OSError, ValueError):
            descriptor = self._stream.fileno()
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, descriptor)
            os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def styled(stream: Any) -> Any:
    """Return a standard stream for colours and moving lines (see ``LastingStream.styled``)."""
    return stream.styled() if isinstance(stream, LastingStream) else stream


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Let the body's output outlast its readers: a pipe that is closed, and of what is told on standard error any loss.

    A terminal that was closed, or a full disk behind standard error, is no reason to end a training; what was asked for
    on standard output and cannot be written is one.
    """
    before = sys.stdout, sys.stderr
    sys.stdout = before[0] and LastingStream(before[0], BrokenPipeError)
    sys.stderr = before[1] and LastingStream(before[1], OSError)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


PLAIN_WIDTH = 100
_GAP = 2  # blanks between two columns
_LEAST_WRAPPED = 12  # columns that a wrapped cell needs to be readable
_MOST_LINES = 3  # of a cell in a table
_INDENT = "    "

Row = Sequence[object]


def screen_width() -> int:
    """Return how many columns a line may have."""
    return shutil.get_terminal_size((PLAIN_WIDTH, 24)).columns if sys.stdout.isatty() else PLAIN_WIDTH


def wrapped(text: str, width: int) -> list[str]:
    """Return a text in lines of at most ``width`` columns; a path or a name that is longer breaks at its marks.

    A piece without any mark is never broken: it can still be copied.
    """
    lines = [""]
    for piece in re.findall(r" *[^ ]+", text):
        if len(lines[-1]) + len(piece) <= width or not lines[-1]:
            lines[-1] += piece
        else:
            lines.append(piece.lstrip())
        if len(lines[-1]) > width:
            lines[-1:] = _broken(lines[-1], width)
    return lines


def _pieces(text: str) -> list[str]:
    """Return what a text may be broken into: at blanks, and behind the marks of paths and names."""
    return re.findall(r"[^ ]+?[/.,_]+(?=[^ /.,_])|[^ ]+", text)


def _broken(word: str, width: int) -> list[str]:
    lines = [""]
    for piece in _pieces(word):
        lines += [""] if lines[-1] and len(lines[-1]) + len(piece) > width else []
        lines[-1] += piece
    return lines


def hanging(text: str, indent: int, first: str = "") -> str:
    """Return a text in lines that fit the screen, the later ones indented.

    Args:
        text: the text.
        indent: blanks before the later lines.
        first: what stands before the text in the first line, padded to the indent; nothing is not padded.
    """
    lines = wrapped(text, max(screen_width() - indent, 2 * _LEAST_WRAPPED))
    lead = f"{first:<{indent}}" if first else ""
    return lead + ("\n" + " " * indent).join(lines)


def table_width(columns: Sequence[str], rows: Sequence[Row]) -> int:
    """Return how many columns of the screen a plain table takes."""
    widths = _widths(columns, _cells(rows))
    return sum(widths) + _GAP * (len(widths) - 1)


def print_table(columns: Sequence[str], rows: Sequence[Row], *, heads: int = 1, lines: bool = True) -> None:
    """Print a table; one that is too wide has its widest columns wrapped, or becomes blocks.

    Args:
        columns: titles.
        rows: cells; None is empty.
        heads: cells that together name a row, the heading of its block.
        lines: whether a terminal gets a table with lines.
    """
    cells = _cells(rows)
    widths = _widths(columns, cells)
    framed = lines and sys.stdout.isatty()
    if framed and sum(widths) + 3 * len(widths) + 1 <= screen_width():
        _print_framed(columns, cells)
        return
    fitted = _fitted(widths, [columns, *cells], screen_width() - _GAP * (len(widths) - 1))
    if fitted is None:
        print_blocks(columns, rows, heads=heads)
    else:
        _print_plain(columns, cells, fitted)


def _fitted(widths: Sequence[int], rows: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """Return widths whose sum fits: titles give way, then the widest columns; None when a cell becomes a ribbon."""
    columns = range(len(widths))
    pieces = [max(max(map(len, _pieces(row[i])), default=0) for row in rows) for i in columns]
    below_titles = [max([pieces[i], *(len(row[i]) for row in rows[1:])]) for i in columns]
    found = list(widths)
    while sum(found) > room:
        wide = [i for i in columns if found[i] > max(below_titles[i], _LEAST_WRAPPED)]
        wide = wide or [i for i in columns if found[i] > max(pieces[i], _LEAST_WRAPPED)]
        if not wide:
            return None
        found[max(wide, key=found.__getitem__)] -= 1
    lines = (len(wrapped(cell, width)) for row in rows for cell, width in zip(row, found, strict=True))
    return found if max(lines) <= _MOST_LINES else None


def print_blocks(columns: Sequence[str], rows: Sequence[Row], *, heads: int = 1) -> None:
    """Print each row as a block: what names it on a line of its own, then a line for each other cell."""
    for row in _cells(rows):
        print("  ".join(filter(None, row[:heads])))
        cells = zip(columns[heads:], row[heads:], strict=True)
        told = [(title, cell) for title, cell in cells if cell not in ("", "-")]
        indent = max((len(title) for title, _ in told), default=0) + len(_INDENT) + _GAP
        for title, cell in told:
            print(hanging(cell, indent, f"{_INDENT}{title}"))


def _cells(rows: Sequence[Row]) -> list[list[str]]:
    return [["" if cell is None else printable(str(cell)).replace("\n", "\\n") for cell in row] for row in rows]


def _widths(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[int]:
    return [max(len(line[i]) for line in (columns, *rows)) for i in range(len(columns))]


def _print_plain(columns: Sequence[str], rows: Sequence[Sequence[str]], widths: Sequence[int]) -> None:
    for row in (columns, *rows):
        for line in _lines(row, widths):
            print((" " * _GAP).join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())


def _lines(row: Sequence[str], widths: Sequence[int]) -> Iterator[list[str]]:
    """Yield the lines of one row; a cell that is wrapped stands on several."""
    parts = [wrapped(cell, width) for cell, width in zip(row, widths, strict=True)]
    for number in range(max(map(len, parts))):
        yield [part[number] if number < len(part) else "" for part in parts]


def _print_framed(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    grid = Table()
    for column in columns:
        grid.add_column(Text(printable(column)))
    for row in rows:
        grid.add_row(*(Text(cell) for cell in row))
    Console(file=styled(sys.stdout)).print(grid)
