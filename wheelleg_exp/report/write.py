"""A report's text, and where it is written: over an earlier report of the same run, and over nothing else."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from wheelleg_exp.errors import RunDirectoryError, printable
from wheelleg_exp.files import for_people, sha256, write_text
from wheelleg_exp.report.blocks import Page
from wheelleg_exp.report.subject import KIND, Subject

# Tells a later report that a file is one, and of which run.
MARK = '<meta name="wheelleg-report" content="'


def render(page: Page) -> str:
    """Return the whole HTML file as text.

    Scripts cannot run in it whatever its values hold: templates escape them, and its own policy forbids scripts and
    everything that would be fetched.
    """
    environment = Environment(
        loader=PackageLoader("wheelleg_exp.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_visible,
    )
    environment.filters["drawn"] = Markup  # for SVG that `svg.clean` has passed, and for the style sheet alone
    style = environment.get_template("report.css").render()
    return environment.get_template("report.html").render(page=page, style=style, mark=MARK)


def _visible(value: Any) -> Any:
    """Show characters that would hide or turn the text around them, and those that HTML cannot hold."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return printable(value)


NAME = "report.html"
_HEAD = 4096  # bytes in which the mark stands


@dataclass(frozen=True)
class Written:
    """A report on the disk: its path, its size in bytes, and whether the run's manifest tells of it."""

    path: Path
    size: int
    recorded: bool


def place(subject: Subject, output: Path | None) -> Path:
    """Return where the report goes.

    Raises:
        RunDirectoryError: there is something else than a report of this run, or nothing can be written there.
    """
    path = subject.path / NAME if output is None else output
    if path.is_dir():
        raise RunDirectoryError(f"'{path}' is a folder", expected="the name of a file, such as report.html")
    if (path.exists() or path.is_symlink()) and not (_is_report(path, subject.id) or _is_own(subject, path)):
        raise RunDirectoryError(
            f"'{path}' exists and is not a report of this run, so it is not overwritten",
            expected="-o with another name",
        )
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    with for_people(path), tempfile.TemporaryFile(dir=folder):  # known before the work begins, and leaving nothing
        return path


def write(subject: Subject, path: Path, html: str, command: Sequence[str]) -> Written:
    """Write the page, and record it in the manifest when it stands in the run directory.

    Raises:
        WheellegError: it cannot be written.
    """
    write_text(path, html)
    inside = subject.run is not None and path.resolve().is_relative_to(subject.path.resolve())
    if subject.run is not None and inside and not _recorded(subject, path):
        subject.run.manifest().add(KIND, [path], command=command)
    return Written(path, path.stat().st_size, inside)


def _is_report(path: Path, run: str) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    with for_people(path, "read"), path.open("rb") as file:
        head = file.read(_HEAD).decode("utf-8", errors="replace")
    return f'{MARK}{escape(run)}">' in head


def _is_own(subject: Subject, path: Path) -> bool:
    """Return whether the run itself knows the file as its report, whatever the run is called by now."""
    inside = not path.is_symlink() and path.is_file() and path.resolve().is_relative_to(subject.path.resolve())
    return inside and _recorded(subject, path)


def _recorded(subject: Subject, path: Path) -> bool:
    """Return whether the manifest knows this very file already."""
    name = path.resolve().relative_to(subject.path.resolve()).as_posix()
    entries = [entry["files"][name] for entry in subject.additions(KIND) if name in entry.get("files", {})]
    return bool(entries) and entries[-1]["sha256"] == sha256(path)
