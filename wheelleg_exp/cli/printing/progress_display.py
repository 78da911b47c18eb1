"""Show the progress of jobs and sweeps: live lines in a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from wheelleg_exp.cli.printing.terminal import hanging, styled
from wheelleg_exp.definitions import percent
from wheelleg_exp.errors import printable
from wheelleg_exp.progress import progress_to
from wheelleg_exp.rl.trainer import Iteration

PLAIN_EVERY_S = 10.0


class LiveLines:
    """Lines on standard error, some of which move while the display is open, where it is a terminal.

    Args:
        columns: what stands between the count and the figures of a moving line.
    """

    def __init__(self, *columns: ProgressColumn) -> None:
        self._console = Console(file=styled(sys.stderr))
        self._live = self._console.is_terminal
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            *columns,
            TextColumn("{task.fields[figures]}"),
            console=self._console,
            transient=True,
        )

    def __enter__(self) -> Self:
        if self._live:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._progress.stop()


class ConsoleDisplay(LiveLines):
    """Shows a job on standard error, so that standard output keeps what was asked for.

    Args:
        quiet: whether the managers' tables are left out.
    """

    def __init__(self, quiet: bool = False) -> None:
        super().__init__(TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
        self._quiet = quiet
        self._last_plain = time.monotonic()
        self._task: TaskID | None = None
        self._listening = ExitStack()

    def __enter__(self) -> Self:
        self._listening.enter_context(progress_to(self._work))
        return super().__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        self._listening.close()

    def environment(self, description: str) -> None:
        """Show the managers' tables."""
        if not self._quiet:
            self._console.print(printable(description), highlight=False, markup=False, soft_wrap=True)

    def note(self, text: str) -> None:
        """Show one line."""
        self._console.print(printable(text), highlight=False, markup=False, soft_wrap=True)

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Show how far training is."""
        self._advance("training", iteration.index + 1, total, figures(iteration.scalars))

    def steps(self, done: int, total: int) -> None:
        """Show how far a rollout is."""
        self._advance("playing", done, total, "")

    def _work(self, what: str, done: int, total: int) -> None:
        """Show how far work is that is over before the job itself begins; in plain lines only when it takes long."""
        if self._live:
            self._advance(what, done, total, "")
            if done == total and self._task is not None:
                self._progress.remove_task(self._task)
                self._task = None
        elif self._is_due():
            self.note(f"{what} {done}/{total}")

    def test(self, name: str, done: int, total: int) -> None:
        """Show how far a test of an evaluation is."""
        self._advance(name, done, total, "")

    def _advance(self, what: str, done: int, total: int, figures: str) -> None:
        if self._live:
            if self._task is None:
                self._task = self._progress.add_task(what, total=total, figures=figures)
            self._progress.update(self._task, description=what, completed=done, total=total, figures=figures)
        elif self._is_due() or done == total:
            self.note(f"{what} {done}/{total}  {figures}".rstrip())

    def _is_due(self) -> bool:
        """Return whether the last plain line is long enough ago for another."""
        now = time.monotonic()
        due = now - self._last_plain >= PLAIN_EVERY_S
        self._last_plain = now if due else self._last_plain
        return due


def figures(scalars: Mapping[str, float]) -> str:
    """Return a training iteration's figures as part of a line, as the list of runs has them."""
    forms: tuple[tuple[str, Callable[[float], str]], ...] = (
        ("Train/mean_reward", "return {:.2f}".format),
        ("Train/mean_episode_length", "episode {:.0f} steps".format),
        ("Episode_Termination/time_out", lambda share: f"time-out {percent(share)}"),
        ("Perf/total_fps", "{:,.0f} steps/s".format),
    )
    return "  ".join(form(scalars[key]) for key, form in forms if key in scalars)


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
