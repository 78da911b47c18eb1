"""What is asked of a robot that is driven: set by hands and scripts in any thread, taken by the one that drives."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.jobs.drive.axes import Axis


@dataclass(frozen=True)
class Push:
    """Add a velocity to the base's, in its yaw axes.

    Attributes:
        x: forwards, m/s.
        y: to the left, m/s.
    """

    x: float
    y: float = 0.0


@dataclass(frozen=True)
class Reset:
    """Begin a new episode."""


@dataclass(frozen=True)
class Choose:
    """Drive another checkpoint, or on another ground; what is None stays.

    Attributes:
        checkpoint: the checkpoint.
        scene: option of the config group ``scene``, or ``own``.
    """

    checkpoint: Path | None = None
    scene: str | None = None


@dataclass(frozen=True)
class Finish:
    """End the drive."""


Request = Push | Reset | Choose | Finish


class Controls:
    """The commands as they are asked for, and requests that wait to be done.

    Args:
        axes: what may be commanded.

    Attributes:
        paused: whether time stands still.
        speed: simulated seconds in one second of the clock on the wall.
    """

    def __init__(self, axes: Sequence[Axis]) -> None:
        self.axes = {axis.name: axis for axis in axes}
        self.paused = False
        self.speed = 1.0
        self._lock = threading.Lock()
        self._values = {axis.name: axis.rest for axis in axes}
        self._requests: list[Request] = []

    @property
    def values(self) -> dict[str, float]:
        """The commands by axis name."""
        with self._lock:
            return dict(self._values)

    def set(self, name: str, value: float) -> None:
        """Ask for a value; what lies beyond the range is brought to its end, and unknown axes count for nothing."""
        if name in self.axes and value == value:
            with self._lock:
                self._values[name] = self.axes[name].bounded(value)

    def steer(self, name: str, share: float) -> None:
        """Ask for a share of the range, from -1 (its low) by 0 (rest) to 1 (its high), as sticks and keys do."""
        if name in self.axes:
            self.set(name, self.axes[name].at(share))

    def stop(self) -> None:
        """Ask for rest on every axis."""
        with self._lock:
            self._values = {name: axis.rest for name, axis in self.axes.items()}

    def request(self, request: Request) -> None:
        """Ask for something to be done once, before the next step."""
        with self._lock:
            self._requests.append(request)

    def take(self) -> list[Request]:
        """Return what has been asked for since the last call, in order."""
        with self._lock:
            taken, self._requests = self._requests, []
        return taken
