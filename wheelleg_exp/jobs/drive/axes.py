"""What of a task's commands can be driven: each axis that is drawn from a range, within that range."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.mdp.commands.ranges import RangedCommand
from wheelleg_exp.sim.timers import forget


@dataclass(frozen=True)
class Axis:
    """One component of a command.

    Attributes:
        name: what scripts and sliders call it: the component, after the term's name where two terms have one.
        term: the command term.
        component: its key in the term's ``ranges``.
        low: lower end of the range, in the component's unit.
        high: upper end.
    """

    name: str
    term: str
    component: str
    low: float
    high: float

    @property
    def key(self) -> str:
        """Config key of the range."""
        return f"env.commands.{self.term}.ranges.{self.component}"

    @property
    def rest(self) -> float:
        """What nobody's hand asks for: 0, or the middle of a range without it."""
        return 0.0 if self.low <= 0.0 <= self.high else 0.5 * (self.low + self.high)

    def at(self, share: float) -> float:
        """Return the value at a share of the way from rest to an end: 1 is ``high``, -1 ``low``."""
        share = min(max(share, -1.0), 1.0)
        end = self.high if share > 0.0 else self.low
        return self.rest + abs(share) * (end - self.rest)

    def bounded(self, value: float) -> float:
        """Return the value of the range that is nearest to ``value``."""
        return min(max(value, self.low), self.high)


def axes_of(env: ManagerBasedRLEnv) -> list[Axis]:
    """Return the axes of all commands that are drawn from ranges, but those whose range is empty, in their order."""
    found = [
        (term, component, float(pair[0]), float(pair[1]))
        for term in env.command_manager.active_terms
        for component, pair in getattr(env.command_manager.get_term(term), "ranges", {}).items()
        if isinstance(env.command_manager.get_term(term), RangedCommand) and pair[0] < pair[1]
    ]
    times = Counter(component for _, component, *_ in found)
    return [Axis(f"{t}.{c}" if times[c] > 1 else c, t, c, low, high) for t, c, low, high in found]


class Hold:
    """Keeps an environment's commands at given values, through resets and redraws.

    A range that is a single value is what every draw gives, so that nothing is written past the command terms.

    Args:
        env: the environment.
        axes: what may be commanded.
    """

    def __init__(self, env: ManagerBasedRLEnv, axes: list[Axis]) -> None:
        self._env, self._axes = env, axes
        self._held: dict[str, float] = {}

    def __call__(self, values: Mapping[str, float]) -> None:
        """Let the coming step end with these commands (by axis name); the observation that it returns has them."""
        changed = [axis for axis in self._axes if self._held.get(axis.name) != values[axis.name]]
        for axis in changed:
            term = self._env.command_manager.get_term(axis.term)
            term.ranges[axis.component] = [values[axis.name]] * 2  # type: ignore[attr-defined]
            term.time_left.zero_()
        if changed:
            forget()
        self._held = dict(values)
