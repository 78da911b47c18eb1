"""The page of several runs or of a sweep: the best setting, and how certain that result is."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from wheelleg_exp import __version__
from wheelleg_exp.config.tree_lookup import leaves
from wheelleg_exp.definitions import LAST, curve_title, scalar_definition
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.inspection.plot_data import Numbers
from wheelleg_exp.inspection.plot_style import Panel, colour
from wheelleg_exp.inspection.training_curves import over_iterations
from wheelleg_exp.report.headline import done, played
from wheelleg_exp.report.page_blocks import Block, Cell, Code, Note, Page, Table
from wheelleg_exp.report.plot_images import drawn
from wheelleg_exp.report.report_page import section
from wheelleg_exp.report.report_subject import AGENT, Subject, open_subject
from wheelleg_exp.report.training_section import picked
from wheelleg_exp.report.value_format import brief, counted, number, percent
from wheelleg_exp.run.run_config import written_config
from wheelleg_exp.run.run_list import find_sweep

# Runs form one group if their configs differ only in the keys in ``_ASIDE``, such as the seed.
_ASIDE = ("seed", "run", "recording", "check", "agent.logger", "agent.save_interval")
_RETURN, _LENGTH, _TIME_OUT = "Train/mean_reward", "Train/mean_episode_length", "Episode_Termination/time_out"
_CURVES = (_RETURN, _LENGTH, _TIME_OUT)
LEAD = f"At the last iteration (return and length: means of {LAST}). Over several seeds: mean ± standard deviation."
BANDS = "The mean over the seeds of a setting, at iterations that all seeds have, and one standard deviation."
# The returns of two runs are comparable only if the runs have equal values for all config keys in ``_MEASURE``.
_MEASURE = ("env.rewards", "env.episode_length_s", "agent.algorithm.gamma")
_FIGURES = ("return", "episode length, steps", "time-out")
_ABSENT = "–"
_MOST_DIFFERENCES = 12


@dataclass(frozen=True)
class Group:
    """Runs that differ only in their seeds; ``settings`` are the config values that other groups do not share."""

    settings: Mapping[str, str]
    runs: Sequence[Subject]

    @property
    def label(self) -> str:
        """The name of the group in legends: its settings, by the last part of their keys."""
        return ", ".join(f"{key.rsplit('.', 1)[-1]}={value}" for key, value in self.settings.items()) or "all runs"

    def last(self, key: str) -> list[float]:
        return [run.scalars[key].values[-1] for run in self.runs if key in run.scalars]


def grouped(subjects: Sequence[Subject]) -> list[Group]:
    """Group runs by their settings; the groups have the order of their first runs."""
    configs = []
    for subject in subjects:
        values = {".".join(map(str, keys)): value for keys, value in leaves(written_config(subject.path))}
        configs.append({key: brief(value) for key, value in values.items() if not _below(key, _ASIDE)})
    keys = sorted({key for config in configs for key in config})
    differing = [key for key in keys if len({config.get(key, _ABSENT) for config in configs}) > 1]
    found: dict[tuple[str, ...], list[Subject]] = {}
    for subject, config in zip(subjects, configs, strict=True):
        found.setdefault(tuple(config.get(key, _ABSENT) for key in differing), []).append(subject)
    return [Group(dict(zip(differing, values, strict=True)), runs) for values, runs in found.items()]


def _below(key: str, keys: Sequence[str]) -> bool:
    return any(key == own or key.startswith(f"{own}.") for own in keys)


def sentence(groups: Sequence[Group]) -> str:
    """Return the headline: the number of runs, and the group with the highest mean return.

    If rewards, episode length, or discount differ, it compares time-outs, or else survival in ``wheelleg play``.
    """
    text = f"{counted(sum(len(group.runs) for group in groups), 'run')} with {counted(len(groups), 'setting')}."
    if len(groups) < 2:
        return text
    other = next((key for key in groups[0].settings if _below(key, _MEASURE)), None)
    if other is None:
        return text + _highest("mean return", [(group, group.last(_RETURN)) for group in groups], number)
    return f"{text} Their returns do not compare, as {other} differs." + (
        _highest("mean time-out share", [(group, group.last(_TIME_OUT)) for group in groups], percent)
        or _highest("mean survival in the last plays", [(group, _survivals(group)) for group in groups], percent)
    )


def _highest(what: str, known: Sequence[tuple[Group, Sequence[float]]], form: Callable[[float], str]) -> str:
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
    """Return the final figures of the groups: mean and standard deviation over their runs."""
    shown = list(groups[0].settings)[:_MOST_DIFFERENCES]
    columns = [*(shown or ["setting"]), "runs", *_FIGURES, "survived the last play"]
    rows = [
        [
            *([Cell(group.settings[key], code=True) for key in shown] or [Cell(group.label)]),
            Cell(str(len(group.runs)), number=True),
            *(Cell(_spread(group.last(key)), number=True) for key in (_RETURN, _LENGTH)),
            Cell(_spread(group.last(_TIME_OUT), share=True), number=True),
            Cell(_spread(_survivals(group), share=True), number=True),
        ]
        for group in groups
    ]
    blocks: list[Block] = [Table("Final figures", columns, rows, titled=False)]
    more = len(groups[0].settings) - len(shown)
    if more > 0:
        blocks.append(Note(f"They differ in {more} more keys: see wheelleg diff A B.", ""))
    single = sum(len(group.runs) == 1 for group in groups)
    if single:
        which = "One setting has" if single == 1 else f"{single} settings have"
        blocks.append(Note(f"{which} a single run, so its spread is unknown. Train more seeds."))
    unequal = {done(run) for group in groups for run in group.runs}
    if len(unequal) > 1:
        blocks.append(Note(f"They were trained for {min(unequal)} to {max(unequal)} iterations."))
    return blocks


def _spread(values: Sequence[float], *, share: bool = False) -> str:
    if not values:
        return _ABSENT
    form = percent if share else number
    mean = form(statistics.fmean(values))
    return mean if len(values) == 1 else f"{mean} ± {form(statistics.stdev(values))}"


def curves(groups: Sequence[Group]) -> list[Block]:
    """Return the learning curves of all groups: means, and one standard deviation."""
    known = {key for group in groups for run in group.runs for key in run.scalars}

    def draw(key: str, axes: Axes) -> None:
        for i, group in enumerate(groups):
            series = [run.scalars[key] for run in group.runs if key in run.scalars]
            at, mean, deviation = course([(one.at, one.values) for one in series])
            if len(at):
                axes.plot(at, mean, color=colour(i), label=group.label, marker="." if len(at) < 15 else None)
                axes.fill_between(at, mean - deviation, mean + deviation, color=colour(i), alpha=0.2, linewidth=0)
        definition = scalar_definition(key)
        over_iterations(axes, "" if definition is None else definition.unit)
        if len(groups) > 1:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

    panels = [Panel(curve_title(key), partial(draw, key)) for key in _CURVES if key in known]
    return [drawn(panels)] if panels else [Note("None of them has finished an iteration.", "")]


def course(series: Sequence[tuple[Sequence[int], Sequence[float]]]) -> tuple[Numbers, Numbers, Numbers]:
    """Return the iterations that all runs have, and a scalar's means and standard deviations over the runs.

    For each run, ``series`` contains the training iterations and the values of one logged scalar, such as a reward.
    With only one run, the scalar's standard deviations over the runs are 0. Only iterations that all runs have are
    used, so that the mean does not jump where one run ends. Long trainings are thinned evenly.
    """
    runs = [{at: value for at, value in zip(*own, strict=True) if math.isfinite(value)} for own in series]
    runs = [run for run in runs if run]
    common = sorted(set.intersection(*map(set, runs))) if runs else []
    common = common[picked(len(common))]
    if not common:
        return np.array([]), np.array([]), np.array([])
    values = np.array([[run[at] for at in common] for run in runs])
    deviation = values.std(axis=0, ddof=1) if len(runs) > 1 else np.zeros(len(common))
    return np.array(common, dtype=np.float64), values.mean(axis=0), deviation


def members(groups: Sequence[Group]) -> list[Block]:
    """Return a table that compares runs, with one row per run."""
    rows = [
        [
            Cell(run.id, code=True),
            Cell(group.label),
            Cell(" ".join(map(str, run.manifest.seeds)), number=True),
            Cell(run.status),
            Cell(str(done(run)), number=True),
            *(Cell(number(run.last(key)), number=True) for key in (_RETURN, _LENGTH)),
            Cell(percent(run.last(_TIME_OUT)), number=True),
        ]
        for group in groups
        for run in group.runs
    ]
    table = Table("The runs", ["run", "setting", "seed", "status", "iterations", *_FIGURES], rows, titled=False)
    return [table, Code("wheelleg report RUN", "a page about one of them")]


COMPARISON = "comparison.html"


def open_several(names: Sequence[str | Path], root: Path) -> tuple[Subject, list[Subject]] | None:
    """Open several runs, and return the folder of their report and the runs; return None if ``names`` is a single run.

    The folder is the sweep's, or else the current one. ``names`` are paths or ids of runs and sweeps, or ``latest``.
    """
    sweeps = [None if str(name) == "latest" else find_sweep(str(name), root) for name in names]
    if len(names) == 1 and sweeps[0] is None:
        return None
    runs: dict[Path, Subject] = {}
    for name, index in zip(names, sweeps, strict=True):
        folders = [name] if index is None else [f for job in index.jobs if (f := index.run_of(job)) and f.is_dir()]
        for subject in [open_subject(folder, root if index is None else Path(folder).parent) for folder in folders]:
            if subject.status == AGENT:
                message = f"'{name}' is not a training run"
                raise RunDirectoryError(message, expected="runs of 'wheelleg train', or a sweep")
            runs[subject.path] = subject
    if not runs:
        raise RunDirectoryError(f"the sweep '{names[0]}' has no run yet", expected="a sweep that has started")
    about = sweeps[0].folder.resolve() if len(names) == 1 and sweeps[0] is not None else Path.cwd()
    return Subject(about, None), list(runs.values())


def several_page(about: Subject, runs: Sequence[Subject], command: Sequence[str]) -> Page:
    """Return the report page about several runs; ``about`` is the sweep's folder or the current folder."""
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
