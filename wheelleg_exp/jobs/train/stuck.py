"""Curricula that do not get on, told by name while training goes on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

_PREFIX, _MARK = "Curriculum/", "stuck"


class StuckCurricula:
    """Finds in an iteration's scalars which curricula say that they are stuck; each is told once as long as it is.

    A curriculum says so by a figure ``stuck``, or ``<part>_stuck``, that is not 0.

    Attributes:
        now: those that are stuck, by term and part.
    """

    def __init__(self) -> None:
        self.now: list[str] = []

    def take(self, index: int, scalars: Mapping[str, float]) -> Iterator[str]:
        """Yield a line for each that is stuck since this iteration.

        Args:
            index: the iteration.
            scalars: what it logs.
        """
        marks = {key: value for key, value in scalars.items() if key.startswith(_PREFIX) and key.endswith(_MARK)}
        if not marks:  # no episode has ended
            return
        before, self.now = self.now, [_name(key) for key, value in marks.items() if value > 0.0]
        for name in self.now:
            if name not in before:
                term, _, part = name.partition("/")
                what = f"env.curriculum.{term}" + (f" ({part})" if part else "")
                yield f"warning: {what} is stuck by iteration {index + 1}: it has not risen within its patience"


def _name(key: str) -> str:
    return key.removeprefix(_PREFIX).removesuffix(_MARK).rstrip("_/")
