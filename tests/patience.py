"""Time limits for tests that wait for other processes. The limits only end tests that hang."""

import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE_S = 600.0

T = TypeVar("T")


def wait_until(condition: Callable[[], T], every_s: float = 0.02) -> T:
    """Return the first true result of ``condition``, or its last result when the time limit ends."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(every_s)
    return found
