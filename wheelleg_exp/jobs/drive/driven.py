"""What was driven, kept as a script that drives the same again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.jobs.drive.controls import Push, Reset


class Driven:
    """Notes changes of commands and what was asked for, by control step.

    Args:
        step_dt: control step, s.
    """

    def __init__(self, step_dt: float) -> None:
        self._step_dt = step_dt
        self._entries: list[tuple[int, dict[str, Any]]] = []
        self._values: dict[str, float] = {}

    def commanded(self, step: int, values: Mapping[str, float]) -> None:
        """Note the commands under which a step is done."""
        changed = {name: value for name, value in values.items() if self._values.get(name) != value}
        if changed:
            self._note(step, changed)
            self._values = dict(values)

    def asked(self, step: int, request: Reset | Push) -> None:
        """Note what is done before a step."""
        self._note(step, {"push": [request.x, request.y]} if isinstance(request, Push) else {"reset": True})

    def script(self, steps: int) -> list[dict[str, Any]]:
        """Return the entries of a script of so many steps."""
        entries = [{"at": self._time(step), **deed} for step, deed in self._entries] or [{"at": 0.0}]
        last = self._entries[-1][0] if self._entries else 0
        entries[-1]["for"] = round(self._time(steps) - self._time(last), 6)
        return entries

    def _note(self, step: int, deed: dict[str, Any]) -> None:
        self._entries.append((step, deed))

    def _time(self, step: int) -> float:
        return round(step * self._step_dt, 6)
