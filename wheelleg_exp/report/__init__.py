"""One HTML file about a run, for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Report:
    """A written report.

    Attributes:
        run: the run's folder.
        path: the file.
        size: its size in bytes.
        notes: what is missing in it and why.
    """

    run: Path
    path: Path
    size: int
    notes: tuple[str, ...]


def make_report(
    run: str | Path,
    root: Path,
    output: Path | None = None,
    command: Sequence[str] = (),
    *,
    pictures: bool = True,
) -> Report:
    """Write the report of a run.

    Args:
        run: a path, an id, ``latest``, or the folder of an agent's run.
        root: the folder of all runs.
        output: the file; by default ``report.html`` in the run directory.
        command: the command line, for the manifest.
        pictures: whether pictures of the robot are made.

    Raises:
        WheellegError: there is no such run, or the file cannot be written or is something else.
    """
    from wheelleg_exp.report import trust
    from wheelleg_exp.report.compile import compile_page
    from wheelleg_exp.report.look import Look
    from wheelleg_exp.report.page import render
    from wheelleg_exp.report.subject import open_subject
    from wheelleg_exp.report.write import place, write

    subject = open_subject(run, root)
    path = place(subject, output)
    look = Look(subject, pictures)
    html = render(compile_page(subject, look, trust.judge(subject)))
    written = write(subject, path, html, command)
    return Report(subject.path, written.path, written.size, tuple(look.notes))
