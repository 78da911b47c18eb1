"""The page of several runs or of a sweep: which setting is better, and how certain that is.

Runs are grouped by their settings. Each group shows the spread over its seeds.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wheelleg_exp import __version__
from wheelleg_exp.config.config_tree import leaves
from wheelleg_exp.definitions import LAST, curve_title, scalar_definition
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.report.headline import done, played
from wheelleg_exp.report.inline_svg import drawn
from wheelleg_exp.report.page_blocks import Block, Cell, Code, Note, Page, Table
from wheelleg_exp.report.report_page import section
from wheelleg_exp.report.report_subject import AGENT, Subject, open_subject
from wheelleg_exp.report.training_section import picked
from wheelleg_exp.report.value_format import brief, counted, number, percent
from wheelleg_exp.run.run_config import written_config
from wheelleg_exp.run.run_index import SweepIndex
from wheelleg_exp.run.run_list import find_sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from wheelleg_exp.inspection.plot_style import Panel


# What makes no difference between two runs: their draws, their names, what is written of them.
_ASIDE = ("seed", "run", "recording", "check", "agent.logger", "agent.save_interval")
_RETURN, _LENGTH, _TIME_OUT = "Train/mean_reward", "Train/mean_episode_length", "Episode_Termination/time_out"
_CURVES = (_RETURN, _LENGTH, _TIME_OUT)
LEAD = f"At the last iteration (return and length: means of {LAST}). Over several seeds: mean ± standard deviation."
BANDS = "The mean over the seeds of a setting, where all of them have a value, and one standard deviation about it."
# Where these differ, a return is not of the same thing.
_MEASURE = ("env.rewards", "env.episode_length_s", "agent.algorithm.gamma")
_FIGURES = ("return", "episode length, steps", "time-out")
_ABSENT = "–"
_MOST_DIFFERENCES = 12


@dataclass(frozen=True)
class Group:
    """Runs that were set to the same but for their seeds.

    Attributes:
        settings: what tells it from the other groups, by key.
        runs: its runs.
    """

    settings: Mapping[str, str]
    runs: Sequence[Subject]

    @property
    def label(self) -> str:
        """What it is called in legends: its settings, by the last part of their keys."""
        return ", ".join(f"{key.rsplit('.', 1)[-1]}={value}" for key, value in self.settings.items()) or "all runs"

    def last(self, key: str) -> list[float]:
        """Return the last value of a scalar of each run that has it."""
        return [run.scalars[key].values[-1] for run in self.runs if key in run.scalars]


def grouped(subjects: Sequence[Subject]) -> list[Group]:
    """Return runs by their settings, in the order in which these first occur."""
    configs = [_settings(subject) for subject in subjects]
    keys = sorted({key for config in configs for key in config})
    differing = [key for key in keys if len({config.get(key, _ABSENT) for config in configs}) > 1]
    found: dict[tuple[str, ...], list[Subject]] = {}
    for subject, config in zip(subjects, configs, strict=True):
        found.setdefault(tuple(config.get(key, _ABSENT) for key in differing), []).append(subject)
    return [Group(dict(zip(differing, values, strict=True)), runs) for values, runs in found.items()]


def _settings(subject: Subject) -> dict[str, str]:
    """Return what a run was set to, by key."""
    found = {".".join(map(str, keys)): value for keys, value in leaves(written_config(subject.path))}
    return {key: brief(value) for key, value in found.items() if not _below(key, _ASIDE)}


def _below(key: str, keys: Sequence[str]) -> bool:
    return any(key == own or key.startswith(f"{own}.") for own in keys)


def sentence(groups: Sequence[Group]) -> str:
    """Return what stands at the top: what was compared, and which group's mean return is the highest.

    Where the settings change what a return is, the shares of episodes that reach the time-out are compared instead,
    of the training or else of the last plays.
    """
    runs = sum(len(group.runs) for group in groups)
    said = f"{counted(runs, 'run')} with {counted(len(groups), 'setting')}."
    if len(groups) < 2:
        return said
    other = next((key for key in groups[0].settings if _below(key, _MEASURE)), None)
    if other is None:
        return said + _highest("mean return", [(group, group.last(_RETURN)) for group in groups], number)
    return f"{said} Their returns do not compare, as {other} differs." + (
        _highest("mean time-out share", [(group, group.last(_TIME_OUT)) for group in groups], percent)
        or _highest("mean survival in the last plays", [(group, _survivals(group)) for group in groups], percent)
    )


def _highest(what: str, known: Sequence[tuple[Group, Sequence[float]]], form: Callable[[float], str]) -> str:
    """Return which groups' mean is the highest, as a sentence; nothing where fewer than two groups have one."""
    means = [(statistics.fmean(values), group.label) for group, values in known if values]
    if len(means) < 2:
        return ""
    best = max(mean for mean, _ in means)
    labels = [label for mean, label in means if mean == best]
    if len(labels) == len(means):
        return f" The {what} is the same, {form(best)}."
    return f" The highest {what}, {form(best)}, is that of {' and of '.join(labels)}."


def _survivals(group: Group) -> list[float]:
    return [float(v) for run in group.runs if isinstance(v := played(run).get("survival"), (int, float))]


def figures(groups: Sequence[Group]) -> list[Block]:
    """Return how the groups ended: mean and standard deviation over their runs."""
    shown = list(groups[0].settings)[:_MOST_DIFFERENCES]
    columns = [*(shown or ["setting"]), "runs", *_FIGURES, "survived the last play"]
    rows = []
    for group in groups:
        rows.append(
            [
                *([Cell(group.settings[key], code=True) for key in shown] or [Cell(group.label)]),
                Cell(str(len(group.runs)), number=True),
                *(Cell(_spread(group.last(key)), number=True) for key in (_RETURN, _LENGTH)),
                Cell(_spread(group.last(_TIME_OUT), share=True), number=True),
                Cell(_spread(_survivals(group), share=True), number=True),
            ]
        )
    blocks: list[Block] = [Table("How they ended", columns, rows, titled=False)]
    more = len(groups[0].settings) - len(shown)
    if more > 0:
        blocks.append(Note(f"They differ in {more} more keys: wheelleg diff A B tells all of two runs.", ""))
    single = sum(len(group.runs) == 1 for group in groups)
    if single:
        which = "One setting has" if single == 1 else f"{single} settings have"
        blocks.append(Note(f"{which} a single run: how much chance is in it is not known. Train more seeds."))
    unequal = {done(run) for group in groups for run in group.runs}
    if len(unequal) > 1:
        blocks.append(Note(f"They were trained for {min(unequal)} to {max(unequal)} iterations."))
    return blocks


def _spread(values: Sequence[float], *, share: bool = False) -> str:
    """Return mean ± standard deviation (of a sample) of some runs' values; the value alone of one run."""
    if not values:
        return _ABSENT
    form = percent if share else number
    mean = form(statistics.fmean(values))
    return mean if len(values) == 1 else f"{mean} ± {form(statistics.stdev(values))}"


def curves(groups: Sequence[Group]) -> list[Block]:
    """Return the learning curves of all groups in one drawing each: means, and one standard deviation about them."""
    known = {key for group in groups for run in group.runs for key in run.scalars}
    panels = [_panel(key, groups) for key in _CURVES if key in known]
    return [drawn(panels, "several")] if panels else [Note("None of them has finished an iteration.", "")]


def _panel(key: str, groups: Sequence[Group]) -> Panel:
    from wheelleg_exp.inspection.plot_style import Panel, colour
    from wheelleg_exp.inspection.training_curves import over_iterations

    def draw(axes: Axes) -> None:
        for i, group in enumerate(groups):
            at, mean, deviation = course(
                [(run.scalars[key].at, run.scalars[key].values) for run in group.runs if key in run.scalars]
            )
            if len(at):
                axes.plot(at, mean, color=colour(i), label=group.label, marker="." if len(at) < 15 else None)
                axes.fill_between(at, mean - deviation, mean + deviation, color=colour(i), alpha=0.2, linewidth=0)
        told = scalar_definition(key)
        over_iterations(axes, "" if told is None else told.unit)
        if len(groups) > 1:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

    return Panel(curve_title(key), draw)


def course(
    series: Sequence[tuple[Sequence[int], Sequence[float]]],
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return iterations, and mean and standard deviation of the runs (of a sample; 0 of one run) there.

    The iterations are those at which all runs have a value, so that no run's end moves the mean; of a long training
    evenly picked ones, (n,). A run without any value does not count.

    Args:
        series: iterations and values of each run.
    """
    runs = [{at: value for at, value in zip(*own, strict=True) if math.isfinite(value)} for own in series]
    runs = [run for run in runs if run]
    common = sorted(set.intersection(*map(set, runs))) if runs else []
    common = common[picked(len(common))]
    if not common:
        return np.array([]), np.array([]), np.array([])
    values = np.array([[run[at] for at in common] for run in runs])
    deviation = values.std(axis=0, ddof=1) if len(runs) > 1 else np.zeros(len(common))
    return np.array(common), values.mean(axis=0), deviation


def members(groups: Sequence[Group]) -> list[Block]:
    """Return the runs, one by one."""
    rows = [
        [
            Cell(run.id, code=True),
            Cell(group.label),
            Cell(" ".join(str(seed) for seed in run.manifest.get("seeds") or []), number=True),
            Cell(run.status),
            Cell(str(done(run)), number=True),
            *(Cell(_spread(_last(run, key)), number=True) for key in (_RETURN, _LENGTH)),
            Cell(_spread(_last(run, _TIME_OUT), share=True), number=True),
        ]
        for group in groups
        for run in group.runs
    ]
    columns = ["run", "setting", "seed", "status", "iterations", *_FIGURES]
    table = Table("The runs", columns, rows, titled=False)
    return [table, Code("wheelleg report RUN", "a page about one of them")]


def _last(run: Subject, key: str) -> list[float]:
    return [run.scalars[key].values[-1]] if key in run.scalars else []


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
    groups = grouped(runs)
    tasks = list(dict.fromkeys(run.task for run in runs))
    unfinished = sum(run.status != "finished" for run in runs)
    return Page(
        run=about.id,
        task=", ".join(tasks),
        status=counted(len(runs), "run"),
        tone="",
        sentence=sentence(groups),
        cards=[],
        facts=[("folder", str(about.path)), ("settings", str(len(groups))), ("not finished", str(unfinished))],
        command=" ".join(command),
        hero=None,
        notes=[Note(f"{run.id}: {problem}") for run in runs for problem in run.problems],
        sections=[
            section("ended", "Which is better?", LEAD, lambda: figures(groups)),
            section("learned", "How they learned", BANDS, lambda: curves(groups)),
            section("runs", "The runs", "", lambda: members(groups)),
        ],
        version=__version__,
    )
