"""How a sweep looks: a live line for each running job in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rich.progress import TaskID, TimeElapsedColumn

from wheelleg_exp.cli.printing.display import PLAIN_EVERY_S, LiveLines, figures
from wheelleg_exp.cli.printing.tables import hanging
from wheelleg_exp.errors import printable


class ConsoleSweepDisplay(LiveLines):
    """Shows a sweep on standard error; a line that several jobs would say is said once."""

    def __init__(self) -> None:
        super().__init__(TimeElapsedColumn())
        self._said: set[str] = set()
        self._last_plain: dict[int, float] = {}
        self._tasks: dict[int, TaskID] = {}
        self._all: TaskID | None = None

    def say(self, text: str) -> None:
        """Show one line of the sweep itself."""
        self._console.print(printable(text), highlight=False, markup=False, soft_wrap=True)

    def checking(self, done: int, total: int) -> None:
        """Show how many jobs have been checked."""
        if not self._live:
            return
        if self._all is None:
            self._all = self._progress.add_task("checking the jobs", total=total, figures="")
        self._progress.update(self._all, completed=done)

    def checked(self) -> None:
        """Show from now on how many jobs have ended."""
        if self._all is not None:
            self._progress.reset(self._all, description="jobs that have ended")

    def started(self, job: Mapping[str, Any]) -> None:
        """Show that a job began."""
        number = job["number"]
        self._last_plain[number] = time.monotonic()
        if self._live:
            self._tasks[number] = self._progress.add_task(_title(job), total=1, figures="")
        else:
            self.say(f"{_title(job)} started")

    def iteration(self, job: Mapping[str, Any], done: int, total: int, scalars: Mapping[str, float]) -> None:
        """Show how far a job's training is."""
        number, now = job["number"], time.monotonic()
        if self._live:
            self._progress.update(self._tasks[number], completed=done, total=total, figures=figures(scalars))
        elif now - self._last_plain[number] >= PLAIN_EVERY_S:
            self._last_plain[number] = now
            self.say(f"job {number}: training {done}/{total}  {figures(scalars)}".rstrip())

    def ended(self, job: Mapping[str, Any]) -> None:
        """Show how a job ended."""
        if self._live:
            task = self._tasks.pop(job["number"], None)
            if task is not None:  # else it was never begun
                self._progress.remove_task(task)
            if self._all is not None:
                self._progress.advance(self._all)
        why = f": {job['error']['message']}" if job["error"] and job["status"] == "failed" else ""
        self.say(f"{_title(job)} {job['status']}{why}")

    def note(self, job: Mapping[str, Any], text: str) -> None:
        """Show one line of a job, unless another has said it before."""
        if text not in self._said:
            self._said.add(text)
            self.say(hanging(f"job {job['number']}: {text}", 4))


def _title(job: Mapping[str, Any]) -> str:
    return f"job {job['number']}" + "".join(f" {text}" for text in job["swept"])
