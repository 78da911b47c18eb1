"""A resume that proves itself: iterations that are computed a second time leave the same digests as the first."""

from __future__ import annotations

from collections.abc import Callable, Mapping


class Proof:
    """Holds iterations past the checkpoint of a resume against what the log had of them.

    Args:
        expected: digests by iteration, as far as the run had come when it was stopped.
        differs: told of the first iteration that is not what it was, with the names of the digests.
        holds: told when all of them were what they had been.
    """

    def __init__(
        self,
        expected: Mapping[int, Mapping[str, str]] | None = None,
        differs: Callable[[int, list[str]], None] | None = None,
        holds: Callable[[int, int], None] | None = None,
    ) -> None:
        self._expected = dict(expected or {})
        self._differs, self._holds = differs, holds
        self._first, self._last = min(self._expected, default=0), max(self._expected, default=-1)

    def check(self, iteration: int, found: Mapping[str, str]) -> None:
        """Take up an iteration that has just been computed."""
        expected = self._expected.pop(iteration, None)
        if expected is None:
            return
        names = sorted(name for name in expected.keys() & found.keys() if expected[name] != found[name])
        if names:
            self._expected.clear()
            if self._differs is not None:
                self._differs(iteration, names)
        elif iteration == self._last and self._holds is not None:
            self._holds(self._first, self._last)
