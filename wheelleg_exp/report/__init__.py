"""Write one HTML file about a run, or about several runs.

| module | offers |
|---|---|
| ``report_subject`` | the files of a run, read as far as possible |
| ``report_page`` | the page of a run: its sections in order, rendered and written |
| ``headline`` | the sentence and key figures at the top |
| ``performance_section``, ``pictures_section``, ``training_section`` | the robot, and its training |
| ``settings_section``, ``provenance_section`` | settings; machine, files, and reproducibility |
| ``several_runs_page`` | the page of several runs: settings, and the spread over seeds |
| ``page_blocks``, ``plot_images``, ``value_format`` | the elements of a page |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Report:
    """A written report: the run's folder, the file with its size in bytes, and notes about missing content."""

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
    """Write the HTML report of one run, or one report that compares several runs.

    ``run`` names training runs (path, id, or ``latest``), sweeps, or folders of zero or random agents' runs. The
    default file is ``report.html`` in the run or sweep folder, or ``comparison.html`` for several runs. Only an earlier
    report of the same run is overwritten. The manifest records ``command``. A missing run or a failed write raises
    WheellegError.
    """
    from wheelleg_exp.report.pictures_section import Look
    from wheelleg_exp.report.provenance_section import judge
    from wheelleg_exp.report.report_page import compile_page, render_page, report_path, write_report
    from wheelleg_exp.report.report_subject import open_subject
    from wheelleg_exp.report.several_runs_page import COMPARISON, open_several, several_page

    names = [run] if isinstance(run, (str, Path)) else list(run)
    several = open_several(names, root)
    if several is not None:
        about, runs = several
        path = report_path(about, Path(COMPARISON) if output is None and len(names) > 1 else output)
        write_report(about, path, render_page(several_page(about, runs, command)), command)
        return Report(about.path, path, path.stat().st_size, ())
    subject = open_subject(names[0], root)
    path = report_path(subject, output)
    look = Look(subject, pictures)
    write_report(subject, path, render_page(compile_page(subject, look, judge(subject))), command)
    return Report(subject.path, path, path.stat().st_size, tuple(look.notes))
