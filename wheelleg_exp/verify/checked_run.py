"""A run that is checked, what is checked of it, and what that found."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.log import IterationLog
from wheelleg_exp.run.manifest import Manifest

_UNENDED = ("running", "crashed")


@dataclass(frozen=True)
class Subject:
    """A run with its manifest and its log, and what became of it."""

    run: RunDirectory
    manifest: Manifest
    status: str
    log: IterationLog

    @property
    def data(self) -> dict[str, Any]:
        """The manifest's content."""
        return self.manifest.data

    @property
    def has_ended(self) -> bool:
        """Whether its process came to an end of its own."""
        return self.status not in _UNENDED

    @property
    def has_snapshot(self) -> bool:
        """Whether what decides the run was completely written; if not, it broke off before the first step."""
        return bool(self.data.get("source")) or self.has_ended


State = Literal["ok", "note", "failed", "not checked"]
_SHOWN = 10  # notes and failures of one check that are shown


@dataclass(frozen=True)
class Check:
    """One thing that was checked.

    Attributes:
        name: what.
        text: one line on what was looked at.
        failures: what is wrong.
        notes: what is worth knowing and not wrong.
        skipped: why it could not be checked; None when it was.
    """

    name: str
    text: str
    failures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    skipped: str | None = None

    @property
    def state(self) -> State:
        """``failed``, ``not checked``, ``note`` or ``ok``."""
        if self.failures:
            return "failed"
        if self.skipped is not None:
            return "not checked"
        return "note" if self.notes else "ok"

    def lines(self) -> list[str]:
        """Return the check for people."""
        head = f"{self.name:<12}{self.state:<12}{self.skipped or self.text}".rstrip()
        return [head, *(f"  {line}" for line in cut(self.failures)), *(f"  note: {line}" for line in cut(self.notes))]


@dataclass(frozen=True)
class RunFindings:
    """What ``verify_run`` found.

    Attributes:
        path: the run directory.
        status: what became of the run.
        checks: all that was checked.
    """

    path: Path
    status: str
    checks: list[Check]

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong."""
        return not any(check.failures for check in self.checks)

    @property
    def verdict(self) -> str:
        """``sound`` or ``damaged``."""
        return "sound" if self.is_sound else "damaged"

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        checks = [{"state": check.state, **asdict(check)} for check in self.checks]
        return {"verdict": self.verdict, "run": str(self.path), "status": self.status, "checks": checks}

    def lines(self) -> list[str]:
        """Return it for people, the verdict last."""
        lines = [f"{self.path.parent.name}/{self.path.name}  {self.status}", ""]
        lines += [line for check in self.checks for line in check.lines()]
        failed = [check.name for check in self.checks if check.failures]
        reason = f"see {', '.join(failed)}" if failed else "the run is what its manifest says, and agrees with itself"
        return [*lines, "", f"{self.verdict}: {reason}"]


def cut(lines: Iterable[str]) -> list[str]:
    """Return the first lines, and how many more there are."""
    found = list(lines)
    rest = len(found) - _SHOWN
    return [*found[:_SHOWN], f"and {rest} more"] if rest > 0 else found
