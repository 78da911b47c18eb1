"""How it learned: curves over the iterations, how episodes ended, what the optimiser did."""

from __future__ import annotations

from wheelleg_exp.definitions.training import title
from wheelleg_exp.report.blocks import Block, More, Note
from wheelleg_exp.report.drawings import drawn
from wheelleg_exp.report.subject import Series, Subject

_POINTS = 800  # of a curve; more cannot be told apart
_FIRST = tuple(title(key) for key in ("Train/mean_reward", "Train/mean_episode_length"))


def first(subject: Subject) -> list[Block]:
    """Return the curves of whether it learned: return, length and end of episodes; a note when there are none."""
    from wheelleg_exp.inspection.plots import training_curves as plots_training

    scalars = thinned(subject)
    if not scalars:
        return [Note("No iteration was finished, so there are no learning curves.", "")]
    panels = [panel for panel in plots_training.learning(scalars) if panel.title in _FIRST]
    return [drawn([*panels, *plots_training.endings(scalars)], "learning")]


def rest(subject: Subject) -> list[Block]:
    """Return the curves of how it learned, on demand."""
    from wheelleg_exp.inspection.plots import training_curves as plots_training

    panels = [panel for panel in plots_training.learning(thinned(subject)) if panel.title not in _FIRST]
    return [More("Tracking errors, losses, exploration and speed", [drawn(panels, "optimiser")])] if panels else []


def thinned(subject: Subject) -> dict[str, tuple[list[int], list[float]]]:
    """Return iterations and values by scalar; of a long training evenly picked ones, the last among them."""
    return {name: _thin(series) for name, series in subject.scalars.items()}


def picked(count: int) -> slice:
    """Return which of so many points are drawn: evenly picked ones, the last among them."""
    every = max(1, -(-count // _POINTS))
    return slice((count - 1) % every, None, every)


def _thin(series: Series) -> tuple[list[int], list[float]]:
    which = picked(len(series.at))
    return list(series.at[which]), list(series.values[which])
