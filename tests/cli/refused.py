from __future__ import annotations

from pathlib import Path

from jobs.small import wheelleg


def refusal(*words: str | Path) -> str:
    """Run a command that must fail with status 2, and return its message, the only line of output."""
    said = wheelleg(*words)
    assert (said.status, said.out) == (2, ""), (said.out, said.err)
    (line,) = said.err.splitlines()
    assert line.startswith("wheelleg: error: ")
    return line
