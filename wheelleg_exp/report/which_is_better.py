"""Which of several settings is better: runs grouped by what they were set to, with the spread over their seeds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from wheelleg_exp.config.tree import leaves
from wheelleg_exp.definitions.training import LAST, scalar, title
from wheelleg_exp.report.blocks import Block, Cell, Code, Note, Table
from wheelleg_exp.report.does_it_stand import done, played
from wheelleg_exp.report.drawings import drawn
from wheelleg_exp.report.how_it_learned import thinned
from wheelleg_exp.report.subject import Subject
from wheelleg_exp.report.words import brief, counted, number, percent
from wheelleg_exp.run.recorded import written_config

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from wheelleg_exp.inspection.plots.style import Panel

# What makes no difference between two runs: their draws, their names, what is written of them.
_ASIDE = ("seed", "run", "recording", "check", "agent.logger", "agent.save_interval")
_RETURN, _LENGTH, _TIME_OUT = "Train/mean_reward", "Train/mean_episode_length", "Episode_Termination/time_out"
_CURVES = (_RETURN, _LENGTH, _TIME_OUT)
LEAD = f"At the last iteration (return and length: means of {LAST}). Over several seeds: mean ± standard deviation."
BANDS = "The mean over the seeds of a setting, and one standard deviation about it."
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
    return {k: brief(v) for k, v in found.items() if not any(k == own or k.startswith(f"{own}.") for own in _ASIDE)}


def sentence(groups: Sequence[Group]) -> str:
    """Return what stands at the top: what was compared, and which group's mean return is the highest."""
    runs = sum(len(group.runs) for group in groups)
    said = f"{counted(runs, 'run')} with {counted(len(groups), 'setting')}."
    known = [(statistics.fmean(values), group) for group in groups if (values := group.last(_RETURN))]
    if len(known) > 1:
        best, group = max(known, key=lambda pair: pair[0])
        said += f" The highest mean return, {number(best)}, is that of {group.label}."
    return said


def figures(groups: Sequence[Group]) -> list[Block]:
    """Return how the groups ended: mean and standard deviation over their runs."""
    shown = list(groups[0].settings)[:_MOST_DIFFERENCES]
    columns = [*(shown or ["setting"]), "runs", *_FIGURES, "survived the last play"]
    rows = []
    for group in groups:
        survival = [float(v) for run in group.runs if isinstance(v := played(run).get("survival"), (int, float))]
        rows.append(
            [
                *([Cell(group.settings[key], code=True) for key in shown] or [Cell(group.label)]),
                Cell(str(len(group.runs)), number=True),
                *(Cell(_spread(group.last(key)), number=True) for key in (_RETURN, _LENGTH)),
                Cell(_spread(group.last(_TIME_OUT), share=True), number=True),
                Cell(_spread(survival, share=True), number=True),
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
    from wheelleg_exp.inspection.plots.style import Panel, colour
    from wheelleg_exp.inspection.plots.training_curves import over_iterations

    def draw(axes: Axes) -> None:
        for i, group in enumerate(groups):
            at, mean, deviation = course([thinned(run).get(key, ([], [])) for run in group.runs])
            if len(at):
                axes.plot(at, mean, color=colour(i), label=group.label, marker="." if len(at) < 15 else None)
                axes.fill_between(at, mean - deviation, mean + deviation, color=colour(i), alpha=0.2, linewidth=0)
        told = scalar(key)
        over_iterations(axes, "" if told is None else told.unit)
        if len(groups) > 1:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

    return Panel(title(key), draw)


def course(
    series: Sequence[tuple[Sequence[int], Sequence[float]]],
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return iterations, and mean and standard deviation over the runs that have a value there.

    Args:
        series: iterations and values of each run.
    """
    by_iteration: dict[int, list[float]] = {}
    for own, values in series:
        for at, value in zip(own, values, strict=True):
            if np.isfinite(value):
                by_iteration.setdefault(int(at), []).append(float(value))
    iterations = sorted(by_iteration)
    found = [by_iteration[at] for at in iterations]
    deviations = [statistics.stdev(values) if len(values) > 1 else 0.0 for values in found]
    return np.array(iterations), np.array([statistics.fmean(values) for values in found]), np.array(deviations)


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
