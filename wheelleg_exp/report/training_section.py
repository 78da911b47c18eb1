"""Report sections on training: curves over iterations, ends of episodes, the optimiser, and reward terms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from wheelleg_exp.definitions import curve_title
from wheelleg_exp.inspection import training_curves
from wheelleg_exp.report.page_blocks import Beside, Block, Cell, More, Note, Table
from wheelleg_exp.report.plot_images import drawn
from wheelleg_exp.report.report_subject import Subject
from wheelleg_exp.report.value_format import brief, exact, number

_POINTS = 800  # A curve in the report has at most 800 points.
_FIRST = tuple(curve_title(key) for key in ("Train/mean_reward", "Train/mean_episode_length"))


def first_curves(subject: Subject) -> list[Block]:
    """Return learning curves of return, episode length, and terminations; a note if no iteration has finished."""
    scalars = thinned(subject)
    if not scalars:
        return [Note("No iteration was finished, so there are no learning curves.", "")]
    panels = [panel for panel in training_curves.learning(scalars) if panel.title in _FIRST]
    return [drawn([*panels, *training_curves.endings(scalars)])]


def more_curves(subject: Subject) -> list[Block]:
    """Return the remaining curves, collapsed."""
    panels = [panel for panel in training_curves.learning(thinned(subject)) if panel.title not in _FIRST]
    return [More("Tracking errors, losses, exploration and speed", [drawn(panels)])] if panels else []


def thinned(subject: Subject) -> dict[str, tuple[list[int], list[float]]]:
    """Return each training scalar with its iterations and values, with no more points than a curve can show."""
    found = {}
    for name, series in subject.scalars.items():
        which = picked(len(series.at))
        found[name] = (list(series.at[which]), list(series.values[which]))
    return found


def picked(count: int) -> slice:
    """Return a slice that selects at most 800 of a curve's ``count`` points, evenly spaced, including the last."""
    every = max(1, -(-count // _POINTS))
    return slice((count - 1) % every, None, every)


_HEAD = "Episode_Reward/"
_RESERVED = ("_target_", "weight")


def reward_blocks(subject: Subject) -> list[Block]:
    """Return a table of the reward terms, and the curve of each reward term over the training."""
    terms = subject.setting("env.rewards")
    if not isinstance(terms, Mapping) or not terms:
        return [Note("The rewards of this task are not known: its parameters are missing.")]
    late: dict[object, float | None] = dict.fromkeys(terms)
    for name in terms:
        series = subject.scalars.get(_HEAD + str(name))
        values = series.values[-max(1, len(series.values) // 10) :] if series else ()
        finite = [value for value in values if math.isfinite(value)]
        late[name] = sum(finite) / len(finite) if finite else None
    total = sum(abs(value) for value in late.values() if value is not None)
    rows, parameters = [], []
    for name, term in terms.items():
        last, node = late[name], term if isinstance(term, Mapping) else {}
        share = Cell("–") if last is None else Cell(number(last), bar=last / total if total else None)
        rows.append([Cell(str(name), code=True), Cell(exact(node.get("weight")), number=True), share])
        if isinstance(term, Mapping):
            own = ", ".join(f"{key}: {brief(value)}" for key, value in term.items() if key not in _RESERVED)
            parameters.append([Cell(text, code=True) for text in (str(name), str(term.get("_target_", "")), own)])
    rows.sort(key=lambda row: -abs(row[-1].bar or 0.0))
    length = subject.setting("env.episode_length_s")
    longest = f"{exact(length)} s" if isinstance(length, (int, float)) else "longest episode's seconds"
    columns = ["Term", "Weight", f"Sum of an episode / {longest}"] if total else ["Term", "Weight"]
    shown: list[Sequence[Cell]] = [row if total else row[:2] for row in rows]
    title = "Reward terms, mean over the last tenth of the training" if total else "Reward terms"
    table = Table(title, columns, shown)
    panels = training_curves.reward_course(thinned(subject))[:1]
    first: Block = Beside([drawn(panels), table]) if panels else table
    columns = ["Term", "Computed by", "Parameters"]
    listed = Table("Terms and their parameters", columns, parameters, titled=False)
    return [first, More("Parameters of each term", [listed])]
