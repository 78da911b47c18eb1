"""Writing the scalars of a training: every iteration at once in a hidden journal, key by key in larger pieces.

A chunk of one row costs about 1.3 kB, whatever it holds. One row a key and iteration would be most of a recording, so
the plots' entities are written some iterations at a time, and the journal's one row keeps what a sudden end would lose.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr

from wheelleg_exp.recording import layout
from wheelleg_exp.recording.writing.frames import Stamp

_TOGETHER = 10  # iterations that a plot's chunk holds

Point = tuple[Stamp, float]
Piece = tuple[str, list[Stamp], Any]


class Scalars:
    """The scalars that are not in the file yet.

    Attributes:
        keys: every key so far, in the order in which they came.
    """

    def __init__(self) -> None:
        self.keys: list[str] = []
        self._points: dict[str, list[Point]] = defaultdict(list)
        self._row: tuple[Stamp, list[float]] | None = None
        self._waiting = 0

    def add(self, stamp: Stamp, values: Mapping[str, float]) -> bool:
        """Take up an iteration's scalars and return whether there was a new key."""
        new = [key for key in values if key not in self.keys]
        self.keys += new
        for key, value in values.items():
            self._points[key].append((stamp, float(value)))
        self._row = (stamp, [float(values.get(key, math.nan)) for key in self.keys])
        self._waiting += 1
        return bool(new)

    def restore(self, keys: list[str], points: Mapping[str, list[Point]]) -> None:
        """Go on with what is already in a file.

        Args:
            keys: the journal's keys.
            points: what stands in the journal alone.
        """
        self.keys = list(keys)
        for key, found in points.items():
            self._points[key] += found
            self._waiting = max(self._waiting, len(found))

    def row(self) -> Piece | None:
        """Return the last iteration's row, once."""
        if self._row is None:
            return None
        stamp, values = self._row
        self._row = None
        columns = rr.Scalars.columns(scalars=np.array(values)).partition([len(values)])
        return layout.JOURNAL, [stamp], columns

    def pieces(self, *, everything: bool) -> Iterator[Piece]:
        """Yield the columns of the plots' entities when there is enough for a chunk, or in any case, once."""
        if self._waiting < _TOGETHER and not everything:
            return
        for key, points in self._points.items():
            values = np.array([value for _, value in points])
            entity = layout.join_key(layout.TRAINING, key)
            yield entity, [stamp for stamp, _ in points], rr.Scalars.columns(scalars=values)
        self._points.clear()
        self._waiting = 0
