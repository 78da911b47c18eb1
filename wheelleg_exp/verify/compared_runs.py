"""The two runs of a comparison, and how much of them is compared."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.directory import CHECKPOINT, RunDirectory
from wheelleg_exp.run.inventory import MANIFEST_NAME
from wheelleg_exp.run.listing import effective_status
from wheelleg_exp.run.log import IterationLog, read_log
from wheelleg_exp.run.manifest import SNAPSHOT
from wheelleg_exp.verify.check_files import damage
from wheelleg_exp.verify.checked_run import Subject

_CLOSED = ("finished", "interrupted")
_OF_ITERATIONS = (MANIFEST_NAME, "iterations.jsonl")


@dataclass(frozen=True)
class Measured:
    """One of the two runs.

    Attributes:
        run: the run.
        status: what became of it.
        log: its iterations.
        damage: what is wrong with its files, by name.
    """

    run: RunDirectory
    status: str
    log: IterationLog
    damage: dict[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Task and id."""
        return f"{self.run.path.parent.name}/{self.run.id}"

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        facts = {"run": str(self.run.path), "status": self.status, "iterations": len(self.log.lines)}
        return {**facts, "problems": [f"{name} {what}" for name, what in self.damage.items()]}


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

    def covers(self, name: str) -> bool:
        """Return whether a file has a part in what is compared: of the first iterations, later files have none."""
        checkpoint = CHECKPOINT.fullmatch(name)
        if self.whole or checkpoint is None:
            return self.whole or name in _OF_ITERATIONS or name.startswith(SNAPSHOT)
        return int(checkpoint[1]) < self.until


def measure(run: RunDirectory) -> Measured:
    """Read what a run became.

    Raises:
        RunDirectoryError: its manifest cannot be read.
    """
    manifest, log = run.manifest(), read_log(run.iterations)
    subject = Subject(run, manifest, effective_status(manifest), log)
    found = damage(subject)
    if run.iterations.exists() and log.problems:
        found.setdefault(run.iterations.name, f"is damaged: {'; '.join(log.problems)}")
    return Measured(run, subject.status, log, found)


def span_of(a: Measured, b: Measured, iterations: int | None, common: bool) -> Span:
    """Return which iterations of two runs are compared (see ``compare_runs``).

    Raises:
        RunDirectoryError: there are none, and no damage is why.
    """
    lengths = len(a.log.lines), len(b.log.lines)
    asked = max(lengths) if iterations is None else iterations
    until = min(*lengths, asked)
    if until < 1 and not (a.damage or b.damage):
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
