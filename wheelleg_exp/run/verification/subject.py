"""The run that is checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.verification.log import IterationLog

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
