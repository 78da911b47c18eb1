"""The two runs of a comparison, and how much of them is compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.listing import effective_status
from wheelleg_exp.run.verification.log import IterationLog, read_log

_CLOSED = ("finished", "interrupted")


@dataclass(frozen=True)
class Measured:
    """One of the two runs.

    Attributes:
        run: the run.
        status: what became of it.
        log: its iterations.
    """

    run: RunDirectory
    status: str
    log: IterationLog

    @property
    def label(self) -> str:
        """Task and id."""
        return f"{self.run.path.parent.name}/{self.run.id}"

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        facts = {"run": str(self.run.path), "status": self.status, "iterations": len(self.log.lines)}
        return {**facts, "problems": self.log.problems}


@dataclass(frozen=True)
class Span:
    """Which iterations are compared.

    Attributes:
        until: those below this number.
        whole: whether these are all that either run has, and will have.
        closed: whether both ended by themselves besides, so that their files are not cut off somewhere.
        shorter: the run that stopped earlier, where that counts: ``A`` or ``B``.
    """

    until: int
    whole: bool
    closed: bool
    shorter: str | None = None


def measure(run: RunDirectory) -> Measured:
    """Read what a run became.

    Raises:
        RunDirectoryError: its manifest cannot be read.
    """
    return Measured(run, effective_status(run.manifest()), read_log(run.iterations))


def span_of(a: Measured, b: Measured, iterations: int | None, common: bool) -> Span:
    """Return which iterations of two runs are compared (see ``compare_runs``).

    Raises:
        RunDirectoryError: there are none.
    """
    lengths = len(a.log.lines), len(b.log.lines)
    asked = max(lengths) if iterations is None else iterations
    until = min(*lengths, asked)
    if until < 1:
        empty = a if not lengths[0] else b
        problem = f": {empty.log.problems[0]}" if empty.log.problems else ""
        raise RunDirectoryError(
            f"no iteration of '{empty.run.id}' can be compared{problem}", expected="runs that trained"
        )
    going = any(side.status == "running" for side in (a, b))
    uneven = min(lengths[0], asked) != min(lengths[1], asked)
    whole = lengths[0] == lengths[1] == until and not going
    closed = whole and all(side.status in _CLOSED for side in (a, b))
    counts = uneven and not common and not going
    return Span(until, whole, closed, ("A" if lengths[0] < lengths[1] else "B") if counts else None)
