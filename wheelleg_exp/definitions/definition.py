"""One figure's definition, and how figures are written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

SHARE = "share"  # the unit of what is shown as a percentage
STEPS = "steps"  # control steps
NOT_FINITE = "a number that is not finite"


@dataclass(frozen=True)
class Definition:
    """What a figure is.

    Attributes:
        label: what stands beside it wherever it is shown to people.
        unit: its unit; empty for a number, a count or a text.
        meaning: of which episodes, environments and steps it is, and what is taken over them.
        of: in a few words, what it is taken over.
    """

    label: str
    unit: str
    meaning: str
    of: str = ""

    @property
    def heading(self) -> str:
        """The label with the unit, as a table's column has it; percentages say themselves what they are."""
        return f"{self.label} ({self.unit})" if self.unit not in ("", SHARE) else self.label


def ending(terms: Iterable[str]) -> str:
    """Return by what an episode ended: the terminations that fired in its last step, so that it counts once.

    An episode that no termination ended had a reward, or a state, that was not finite.
    """
    return " and ".join(terms) or NOT_FINITE


def percent(share_: float) -> str:
    """Return a share as a percentage, ``93.8%``: nearly all is not all, and nearly none is not none."""
    shown = min(max(round(100.0 * share_, 1), 0.1), 99.9) if 0.0 < share_ < 1.0 else 100.0 * share_
    return f"{shown:.1f}%"


def share(part: int, whole: int) -> str:
    """Return a share with what it is of, ``93.8% (60 of 64)``: 1 of 1 says little; a dash for a share of nothing."""
    return f"{percent(part / whole)} ({part} of {whole})" if whole else "-"
