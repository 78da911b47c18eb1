"""Show the progress of jobs and sweeps: live lines in a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Self

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
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.progress import progress_to
from wheelleg_exp.rl.trainer import Iteration
from wheelleg_exp.run.run_index import JobEntry

PLAIN_EVERY_S = 10.0


class LiveLines:
    """Progress on standard error: live lines on a terminal, plain lines elsewhere; ``columns`` follow the count."""

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

    def say(self, text: str) -> None:
        self._console.print(printable(text), highlight=False, markup=False, soft_wrap=True)

    def __enter__(self) -> Self:
        if self._live:
            self._progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live:
            self._progress.stop()


class ConsoleDisplay(LiveLines, Display):
    """Show a job's progress on standard error; if ``quiet`` is true, do not print each manager's table of terms."""

    def __init__(self, quiet: bool = False) -> None:
        super().__init__(TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
        self._quiet = quiet
        self._last_plain = time.monotonic()
        self._task: TaskID | None = None
        self._listening = ExitStack()

    def __enter__(self) -> Self:
        self._listening.enter_context(progress_to(self._work))
        return super().__enter__()

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self._listening.close()

    def environment(self, description: str) -> None:
        if not self._quiet:
            self.say(description)

    def note(self, text: str) -> None:
        self.say(text)

    def iteration(self, iteration: Iteration, total: int) -> None:
        self._advance("training", iteration.index + 1, total, figures(iteration.scalars))

    def steps(self, done: int, total: int) -> None:
        self._advance("playing", done, total, "")

    def _work(self, what: str, done: int, total: int) -> None:
        """Show the progress of a job's preparation; without a terminal, print lines only for a slow preparation."""
        if self._live:
            self._advance(what, done, total, "")
            if done == total and self._task is not None:
                self._progress.remove_task(self._task)
                self._task = None
        elif self._is_due():
            self.note(f"{what} {done}/{total}")

    def test(self, name: str, done: int, total: int) -> None:
        self._advance(name, done, total, "")

    def _advance(self, what: str, done: int, total: int, figures: str) -> None:
        if self._live:
            if self._task is None:
                self._task = self._progress.add_task(what, total=total, figures=figures)
            self._progress.update(self._task, description=what, completed=done, total=total, figures=figures)
        elif self._is_due() or done == total:
            self.note(f"{what} {done}/{total}  {figures}".rstrip())

    def _is_due(self) -> bool:
        now = time.monotonic()
        due = now - self._last_plain >= PLAIN_EVERY_S
        self._last_plain = now if due else self._last_plain
        return due


def figures(scalars: Mapping[str, float]) -> str:
    """Return a training iteration's figures as text: those that ``wheelleg list`` also shows."""
    forms: tuple[tuple[str, Callable[[float], str]], ...] = (
        ("Train/mean_reward", "return {:.2f}".format),
        ("Train/mean_episode_length", "episode {:.0f} steps".format),
        ("Episode_Termination/time_out", lambda share: f"time-out {percent(share)}"),
        ("Perf/total_fps", "{:,.0f} steps/s".format),
    )
    return "  ".join(form(scalars[key]) for key, form in forms if key in scalars)


class ConsoleSweepDisplay(LiveLines):
    """Show a sweep's progress on standard error; print equal notes of several jobs of the sweep only once."""

    def __init__(self) -> None:
        super().__init__(TimeElapsedColumn())
        self._shown: set[str] = set()
        self._last_plain: dict[int, float] = {}
        self._tasks: dict[int, TaskID] = {}
        self._all: TaskID | None = None

    def checking(self, done: int, total: int) -> None:
        if not self._live:
            return
        if self._all is None:
            self._all = self._progress.add_task("checking the jobs", total=total, figures="")
        self._progress.update(self._all, completed=done)

    def checked(self) -> None:
        """Reset a sweep's progress bar, so that it counts the ended jobs instead of the checked jobs."""
        if self._all is not None:
            self._progress.reset(self._all, description="jobs that have ended")

    def started(self, job: JobEntry) -> None:
        number = job["number"]
        self._last_plain[number] = time.monotonic()
        if self._live and number not in self._tasks:  # A preempted job starts several times.
            self._tasks[number] = self._progress.add_task(_title(job), total=1, figures="")
        elif not self._live:
            self.say(f"{_title(job)} started")

    def iteration(self, job: JobEntry, done: int, total: int, scalars: Mapping[str, float]) -> None:
        number, now = job["number"], time.monotonic()
        if self._live:
            self._progress.update(self._tasks[number], completed=done, total=total, figures=figures(scalars))
        elif now - self._last_plain[number] >= PLAIN_EVERY_S:
            self._last_plain[number] = now
            self.say(f"job {number}: training {done}/{total}  {figures(scalars)}".rstrip())

    def ended(self, job: JobEntry) -> None:
        if self._live:
            task = self._tasks.pop(job["number"], None)
            if task is not None:  # A sweep job that was never started has no progress bar.
                self._progress.remove_task(task)
            if self._all is not None:
                self._progress.advance(self._all)
        error = job["error"]
        why = f": {error['message']}" if isinstance(error, Mapping) and job["status"] == "failed" else ""
        self.say(f"{_title(job)} {job['status']}{why}")

    def note(self, job: JobEntry, text: str, *, once: bool = True) -> None:
        """Print the note ``text`` of a sweep job, unless ``once`` is true and the same note was already printed."""
        if not once or text not in self._shown:
            self._shown.add(text)
            self.say(hanging(f"job {job['number']}: {text}", 4))


def _title(job: JobEntry) -> str:
    return f"job {job['number']}" + "".join(f" {text}" for text in job["swept"])
