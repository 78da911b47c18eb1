"""The page of several runs, or of a sweep: which setting is better, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wheelleg_exp import __version__
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.report import which_is_better as settings
from wheelleg_exp.report.blocks import Note, Page
from wheelleg_exp.report.compile import section
from wheelleg_exp.report.subject import AGENT, Subject, open_subject
from wheelleg_exp.report.words import counted
from wheelleg_exp.run.choosing import find_sweep
from wheelleg_exp.run.sweep_index import SweepIndex

COMPARISON = "comparison.html"


def open_several(names: Sequence[str | Path], root: Path) -> tuple[Subject, list[Subject]] | None:
    """Return what a page about several runs is about, and the runs; None where one run is named.

    What it is about is the sweep, or the present folder.

    Args:
        names: runs and sweeps, by path, id or (of runs) ``latest``.
        root: the folder of all runs.

    Raises:
        RunDirectoryError: one is neither, or an agent's run, or a sweep has no run yet.
    """
    sweeps = [None if str(name) == "latest" else find_sweep(str(name), root) for name in names]
    if len(names) == 1 and sweeps[0] is None:
        return None
    runs: dict[Path, Subject] = {}
    for name, index in zip(names, sweeps, strict=True):
        for subject in [open_subject(name, root)] if index is None else _runs_of(index):
            if subject.status == AGENT:
                raise RunDirectoryError(f"'{name}' is no training", expected="runs of 'wheelleg train', or a sweep")
            runs[subject.path] = subject
    if not runs:
        raise RunDirectoryError(f"the sweep '{names[0]}' has no run yet", expected="a sweep that has begun")
    about = sweeps[0].folder.resolve() if len(names) == 1 and sweeps[0] is not None else Path.cwd()
    return Subject(about, None), list(runs.values())


def _runs_of(index: SweepIndex) -> list[Subject]:
    folders = [folder for job in index.jobs if (folder := index.run_of(job)) is not None]
    return [open_subject(folder, folder.parent) for folder in folders if folder.is_dir()]


def several_page(about: Subject, runs: Sequence[Subject], command: Sequence[str]) -> Page:
    """Return the page.

    Args:
        about: what it is about, see ``open_several``.
        runs: the runs.
        command: the command line.
    """
    groups = settings.grouped(runs)
    tasks = list(dict.fromkeys(run.task for run in runs))
    unfinished = sum(run.status != "finished" for run in runs)
    return Page(
        run=about.id,
        task=", ".join(tasks),
        status=counted(len(runs), "run"),
        tone="",
        sentence=settings.sentence(groups),
        cards=[],
        facts=[("folder", str(about.path)), ("settings", str(len(groups))), ("not finished", str(unfinished))],
        command=" ".join(command),
        hero=None,
        notes=[Note(f"{run.id}: {problem}") for run in runs for problem in run.problems],
        sections=[
            section("ended", "Which is better?", settings.LEAD, lambda: settings.figures(groups)),
            section("learned", "How they learned", settings.BANDS, lambda: settings.curves(groups)),
            section("runs", "The runs", "", lambda: settings.members(groups)),
        ],
        version=__version__,
    )
