"""Real time: when the next control step is due, and when the next picture."""

from __future__ import annotations

import time
from collections.abc import Callable

_MOST_BEHIND_S = 0.1  # later than that is not made up for: a machine that is too slow shows slow motion


class Pace:
    """Waits between control steps as long as they last.

    Args:
        step_dt: control step, s.
        frames_per_s: pictures in one second of the clock on the wall.
        clock: returns that clock, s.
        sleep: waits so many seconds.
    """

    def __init__(
        self,
        step_dt: float,
        frames_per_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._step_dt, self._frame_s = step_dt, 1.0 / frames_per_s
        self._clock, self._sleep = clock, sleep
        self._due = self._next_frame = clock()

    def wait(self, speed: float) -> None:
        """Wait until the next step is due.

        Args:
            speed: simulated seconds in one second.
        """
        self._due = max(self._due + self._step_dt / speed, self._clock() - _MOST_BEHIND_S)
        left = self._due - self._clock()
        if left > 0.0:
            self._sleep(left)

    def is_frame_due(self) -> bool:
        """Return whether a picture is due, and count it as shown."""
        now = self._clock()
        if now < self._next_frame:
            return False
        self._next_frame += self._frame_s
        if self._next_frame <= now:
            self._next_frame = now + self._frame_s
        return True
