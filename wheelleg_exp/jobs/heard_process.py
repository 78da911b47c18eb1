"""A process that does one job: heard while it goes, asked to stop, and ended when it is left."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Self

from wheelleg_exp.jobs.processes import Child, Event, listen
from wheelleg_exp.stop_request import StopRequest

_WAIT_S = 0.2
_PATIENCE_S = 10.0


class HeardProcess(ABC):
    """A job in a process of its own; left, it has ended.

    Attributes:
        stop: asks to stop.
    """

    stop: StopRequest
    _child: Child

    @abstractmethod
    def _start(self) -> Child:
        """Start the process."""

    @abstractmethod
    def _require_finished(self, status: int) -> None:
        """Raise what is to be told of a job that ended with an exit status without having finished."""

    def __enter__(self) -> Self:
        self._child = self._start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End what still runs: politely, then at once, then by force."""
        try:
            self._end(self._child.ask_to_stop, 0.0 if self.stop.requested else _PATIENCE_S)
            self._end(self._child.interrupt, _PATIENCE_S)
        finally:
            self._child.kill()
            self._child.process.wait()
            self._child.close()

    def events(self) -> Iterator[Event]:
        """Yield what it tells; its lines for people come as ``note``.

        Raises:
            WheellegError: it failed, with the exit status that it had.
            Interrupted: it was stopped.
        """
        while self._child.open:
            if self.stop.requested:
                self._child.ask_to_stop()
            for _, event in listen([self._child], _WAIT_S):
                yield event
        self._require_finished(self._child.process.wait())

    def _end(self, act: Callable[[], None], patience_s: float) -> None:
        if self._child.process.poll() is not None:
            return
        act()
        deadline = time.monotonic() + patience_s
        while self._child.process.poll() is None and time.monotonic() < deadline:
            for _ in listen([self._child], 0.05):  # it may have to be heard before it can end
                pass
