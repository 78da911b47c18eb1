"""Time limits for tests that wait for other processes, and a limit of the cases of a test."""

import time
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import pytest

PATIENCE_S = 600.0  # This limit only ends tests that hang.

T = TypeVar("T")


def wait_until(condition: Callable[[], T], every_s: float = 0.02) -> T:
    """Return the first true result of ``condition``, or its last result when the time limit ends."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(every_s)
    return found


def thinned(rows: Iterable[Any], every: int) -> list[Any]:
    """Return each ``every``-th row of parameters, and the other rows with the mark ``full``."""
    columns = [row if isinstance(row, tuple) else (row,) for row in rows]
    return [pytest.param(*row, marks=pytest.mark.full if n % every else ()) for n, row in enumerate(columns)]
