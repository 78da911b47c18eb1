"""How long tests wait for others: limits are there against hanging alone, and no core is so busy that they matter."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE_S = 600.0

T = TypeVar("T")


def wait_until(condition: Callable[[], T], every_s: float = 0.02) -> T:
    """Return what ``condition`` returns as soon as that counts as true, or whatever it is when patience ends."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(every_s)
    return found
