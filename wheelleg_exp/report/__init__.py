"""One HTML file about a run, for people; a section is a module, named by the question that it answers.

| module | offers |
|---|---|
| ``subject`` | the files of a run, read as far as they can be read |
| ``compile`` | the sections one after the other |
| ``does_it_stand``, ``how_it_stood``, ``how_it_looked``, ``how_it_learned`` | the robot, and the training |
| ``what_was_measured``, ``what_was_set``, ``what_it_optimises``, ``what_it_ran_on`` | recording, config, machine |
| ``several``, ``which_is_better`` | the page of several runs: settings, and the spread over seeds |
| ``can_it_be_repeated`` | the run against its own manifest, replays and equal runs |
| ``blocks``, ``drawings``, ``svg``, ``words`` | what a page is made of |
| ``write`` | the text of the page, and where it goes |
"""

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
    run: str | Path | Sequence[str | Path],
    root: Path,
    output: Path | None = None,
    command: Sequence[str] = (),
    *,
    pictures: bool = True,
) -> Report:
    """Write the report of a run, or of several: of a sweep into its folder, else as ``comparison.html``.

    Args:
        run: a path, an id, ``latest``, the folder of an agent's run, or a sweep; or several of these.
        root: the folder of all runs.
        output: the file; by default ``report.html`` in the run directory.
        command: the command line, for the manifest.
        pictures: whether pictures of the robot are made.

    Raises:
        WheellegError: there is no such run, or the file cannot be written or is something else.
    """
    from wheelleg_exp.report import can_it_be_repeated as trust
    from wheelleg_exp.report.compile import compile_page
    from wheelleg_exp.report.how_it_looked import Look
    from wheelleg_exp.report.several import COMPARISON, open_several, several_page
    from wheelleg_exp.report.subject import open_subject
    from wheelleg_exp.report.write import place, render, write

    names = [run] if isinstance(run, (str, Path)) else list(run)
    several = open_several(names, root)
    if several is not None:
        about, runs = several
        path = place(about, Path(COMPARISON) if output is None and len(names) > 1 else output)
        written = write(about, path, render(several_page(about, runs, command)), command)
        return Report(about.path, written.path, written.size, ())
    run = names[0]
    subject = open_subject(run, root)
    path = place(subject, output)
    look = Look(subject, pictures)
    html = render(compile_page(subject, look, trust.judge(subject)))
    written = write(subject, path, html, command)
    return Report(subject.path, written.path, written.size, tuple(look.notes))
