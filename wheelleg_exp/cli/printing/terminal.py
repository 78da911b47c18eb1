"""Write text and tables to the terminal, or to a pipe.

Text fits the terminal's width, or else 100 columns. If the reader closes the pipe, the command continues silently.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import zip_longest
from pathlib import Path
from typing import TextIO, cast

from wheelleg_exp.errors import printable


class LastingStream:
    """A text stream to a pipe that ignores writes after the reading process has closed the pipe.

    ``write`` ignores exceptions in ``losses``. Unless ``styled``, control characters become readable text.
    """

    def __init__(self, stream: TextIO, *losses: type[OSError], styled: bool = False) -> None:
        self._stream, self._losses, self._styled = stream, losses, styled

    def styled(self) -> LastingStream:
        """Return the stream that writes control characters unchanged; the caller must escape untrusted text."""
        return LastingStream(self._stream, *self._losses, styled=True)

    def write(self, text: str) -> int:
        """Write a text and return its length; a question mark replaces each character that the encoding lacks."""
        shown = text if self._styled else printable(text)
        try:
            try:
                self._stream.write(shown)
            except UnicodeEncodeError as error:
                self._stream.write(shown.encode(error.encoding, "replace").decode(error.encoding))
        except self._losses:
            self._redirect()
        return len(text)

    def flush(self) -> None:
        """Flush the text stream; raise no error if the reader has closed the pipe."""
        try:
            self._stream.flush()
        except self._losses:
            self._redirect()

    def _redirect(self) -> None:
        """Redirect the stream to the null device, so that flushing the stream when Python exits raises no error."""
        with suppress(OSError, ValueError):
            descriptor = self._stream.fileno()
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, descriptor)
            os.close(null)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


def styled(stream: TextIO) -> TextIO:
    """Return a variant of standard output or standard error that writes ANSI colour codes unchanged."""
    return cast("TextIO", stream.styled()) if isinstance(stream, LastingStream) else stream


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Inside the ``with`` block, ignore all write errors on standard error, and a closed pipe on standard output.

    A closed terminal or a full disk must not stop a training, but a result on standard output must not be lost.
    """
    before = sys.stdout, sys.stderr
    sys.stdout = before[0] and LastingStream(before[0], BrokenPipeError)
    sys.stderr = before[1] and LastingStream(before[1], OSError)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def tool(name: str) -> str:
    """Return the command for a program of this environment: its name, or its path if it is not on the PATH."""
    installed = Path(sys.executable).parent / name
    return name if shutil.which(name) or not installed.exists() else shown(installed)


def shown(path: Path) -> str:
    """Return a path relative to the current folder, or unchanged if the path is outside the current folder."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


PLAIN_WIDTH = 100
_GAP = 2  # A printed table has 2 spaces between two columns.
_LEAST_WRAPPED = 12  # A wrapped table column is at least 12 characters wide.
_MOST_LINES = 3  # A wrapped table cell has at most 3 lines.
_INDENT = "    "

Row = Sequence[object]


def screen_width() -> int:
    """Return the width of the terminal in characters, or 100 without a terminal."""
    return shutil.get_terminal_size((PLAIN_WIDTH, 24)).columns if sys.stdout.isatty() else PLAIN_WIDTH


def wrapped(text: str, width: int) -> list[str]:
    """Wrap a text into lines of at most ``width`` characters.

    A longer word is split only after ``/``, ``.``, ``,`` or ``_``; any other word stays whole, so that users can copy
    it.
    """
    lines = [""]
    for piece in re.findall(r" *[^ ]+", text):
        if len(lines[-1]) + len(piece) <= width or not lines[-1]:
            lines[-1] += piece
        else:
            lines.append(piece.lstrip())
        if len(lines[-1]) > width:
            parts = _pieces(lines.pop())
            lines.append("")
            for part in parts:
                lines += [""] if lines[-1] and len(lines[-1]) + len(part) > width else []
                lines[-1] += part
    return lines


def _pieces(text: str) -> list[str]:
    """Split a text at the places where it can break: at spaces, and after ``/``, ``.``, ``,`` and ``_``."""
    return re.findall(r"[^ ]+?[/.,_]+(?=[^ /.,_])|[^ ]+", text)


def hanging(text: str, indent: int, first: str = "") -> str:
    """Wrap a text to the terminal's width after the label ``first``, with a hanging indent of ``indent`` characters."""
    lines = wrapped(text, max(screen_width() - indent, 2 * _LEAST_WRAPPED))
    lead = f"{first:<{indent}}" if first else ""
    return lead + ("\n" + " " * indent).join(lines)


def table_width(columns: Sequence[str], rows: Sequence[Row]) -> int:
    """Return the width, in characters, of a table without lines between the cells."""
    widths = _widths(columns, _cells(rows))
    return sum(widths) + _GAP * (len(widths) - 1)


def print_table(columns: Sequence[str], rows: Sequence[Row], *, heads: int = 1, lines: bool = True) -> None:
    """Print a table; if the table is too wide for the terminal, wrap wide columns or print each row as several lines.

    The first ``heads`` cells become the heading of such lines. In a terminal, ``lines`` draws lines between the cells.
    """
    cells = _cells(rows)
    widths = _widths(columns, cells)
    if lines and sys.stdout.isatty() and sum(widths) + 3 * len(widths) + 1 <= screen_width():
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

        grid = Table()
        for column in columns:
            grid.add_column(Text(printable(column)))
        for row in cells:
            grid.add_row(*(Text(cell) for cell in row))
        Console(file=styled(sys.stdout)).print(grid)
        return
    fitted = _fitted(widths, [columns, *cells], screen_width() - _GAP * (len(widths) - 1))
    if fitted is None:
        print_blocks(columns, rows, heads=heads)
    else:
        for texts in (columns, *cells):
            parts = [wrapped(cell, width) for cell, width in zip(texts, fitted, strict=True)]
            for line in zip_longest(*parts, fillvalue=""):
                print((" " * _GAP).join(cell.ljust(width) for cell, width in zip(line, fitted, strict=True)).rstrip())


def _fitted(widths: Sequence[int], rows: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """Return table column widths with a sum of at most ``room``; None if the cells cannot be wrapped to this width."""
    # Narrow the table columns with long titles first, and then the widest columns.
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
    """Print each row as a block: a line with the first ``heads`` cells, then one line for each other cell."""
    for row in _cells(rows):
        print("  ".join(filter(None, row[:heads])))
        cells = zip(columns[heads:], row[heads:], strict=True)
        filled = [(title, cell) for title, cell in cells if cell not in ("", "-")]
        indent = max((len(title) for title, _ in filled), default=0) + len(_INDENT) + _GAP
        for title, cell in filled:
            print(hanging(cell, indent, f"{_INDENT}{title}"))


def _cells(rows: Sequence[Row]) -> list[list[str]]:
    return [["" if cell is None else printable(str(cell)).replace("\n", "\\n") for cell in row] for row in rows]


def _widths(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[int]:
    return [max(len(line[i]) for line in (columns, *rows)) for i in range(len(columns))]
