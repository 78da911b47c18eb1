"""Report sections on training: curves over iterations, ends of episodes, the optimiser, and reward terms.

Each reward term is listed with its weight and its contribution at the end of training.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from wheelleg_exp.definitions import curve_title
from wheelleg_exp.report.inline_svg import drawn
from wheelleg_exp.report.page_blocks import Beside, Block, Cell, More, Note, Table
from wheelleg_exp.report.report_subject import Series, Subject
from wheelleg_exp.report.value_format import brief, exact, number

_POINTS = 800  # per curve; more points are not visible
_FIRST = tuple(curve_title(key) for key in ("Train/mean_reward", "Train/mean_episode_length"))


def first_curves(subject: Subject) -> list[Block]:
    """Return the curves of return, episode length, and endings; a note if there are none."""
    from wheelleg_exp.inspection import training_curves as plots_training

    scalars = thinned(subject)
    if not scalars:
        return [Note("No iteration was finished, so there are no learning curves.", "")]
    panels = [panel for panel in plots_training.learning(scalars) if panel.title in _FIRST]
    return [drawn([*panels, *plots_training.endings(scalars)], "learning")]


def more_curves(subject: Subject) -> list[Block]:
    """Return the remaining curves, collapsed."""
    from wheelleg_exp.inspection import training_curves as plots_training

    panels = [panel for panel in plots_training.learning(thinned(subject)) if panel.title not in _FIRST]
    return [More("Tracking errors, losses, exploration and speed", [drawn(panels, "optimiser")])] if panels else []


def thinned(subject: Subject) -> dict[str, tuple[list[int], list[float]]]:
    """Return iterations and values by scalar. Long trainings are thinned evenly, keeping the last point."""
    return {name: _thin(series) for name, series in subject.scalars.items()}


def picked(count: int) -> slice:
    """Return a slice that thins this many points evenly and keeps the last one."""
    every = max(1, -(-count // _POINTS))
    return slice((count - 1) % every, None, every)


def _thin(series: Series) -> tuple[list[int], list[float]]:
    which = picked(len(series.at))
    return list(series.at[which]), list(series.values[which])


_HEAD = "Episode_Reward/"
_RESERVED = ("_target_", "weight")


def reward_blocks(subject: Subject) -> list[Block]:
    """Return the table of reward terms, and their curves over the training."""
    terms = subject.setting("env.rewards")
    if not isinstance(terms, Mapping) or not terms:
        return [Note("The rewards of this task are not known: its parameters are missing.")]
    late = {name: _late(subject.scalars.get(_HEAD + str(name))) for name in terms}
    total = sum(abs(value) for value in late.values() if value is not None)
    rows = [_row(str(name), term, late[name], total) for name, term in terms.items()]
    rows.sort(key=lambda row: -abs(row[-1].bar or 0.0))
    columns = ["Term", "Weight", f"Sum of an episode / {_longest(subject)}"] if total else ["Term", "Weight"]
    shown: list[Sequence[Cell]] = [row if total else row[:2] for row in rows]
    title = "Reward terms, mean over the last tenth of the training" if total else "Reward terms"
    table = Table(title, columns, shown)
    from wheelleg_exp.inspection import training_curves as plots_training

    panels = plots_training.reward_course(thinned(subject))[:1]
    first: Block = Beside([drawn(panels, "rewards"), table]) if panels else table
    return [first, *_parameters(terms)]


def _longest(subject: Subject) -> str:
    """Return the divisor of ``Episode_Reward``: the longest episode's duration."""
    length = subject.setting("env.episode_length_s")
    return f"{exact(length)} s" if isinstance(length, (int, float)) else "longest episode's seconds"


def _late(series: Series | None) -> float | None:
    if series is None:
        return None
    last = [value for value in series.values[-max(1, len(series.values) // 10) :] if math.isfinite(value)]
    return sum(last) / len(last) if last else None


def _row(name: str, term: Any, late: float | None, total: float) -> list[Cell]:
    weight = term.get("weight") if isinstance(term, Mapping) else None
    share = None if late is None or not total else late / total
    return [
        Cell(name, code=True),
        Cell(exact(weight), number=True),
        Cell("–") if late is None else Cell(number(late), bar=share),
    ]


def _parameters(terms: Mapping[str, Any]) -> list[Block]:
    """Return the parameters of the terms, collapsed."""
    rows = []
    for name, term in terms.items():
        if isinstance(term, Mapping):
            own = ", ".join(f"{key}: {brief(value)}" for key, value in term.items() if key not in _RESERVED)
            rows.append(
                [Cell(str(name), code=True), Cell(str(term.get("_target_", "")), code=True), Cell(own, code=True)]
            )
    columns = ("Term", "Computed by", "Parameters")
    return [More("Parameters of each term", [Table("Terms and their parameters", columns, rows, titled=False)])]
