"""Stop a job on Ctrl-C: the first signal asks the job to stop at its next whole point; a second stops it at once."""

from __future__ import annotations

import signal
import threading
from types import FrameType

from wheelleg_exp.errors import Interrupted

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


def stop_signals() -> list[signal.Signals]:
    """Return the signals that ask this program to stop, except signals ignored because of ``nohup`` or ``&``."""
    numbers = [signal.Signals[name] for name in _NAMES if hasattr(signal, name)]
    return [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]


class StopRequest:
    """The first stop signal sets ``requested``; a second one except SIGHUP, which can come twice, interrupts."""

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[signal.Signals, signal._HANDLER] = {}

    def check(self, agreed: bool | None = None) -> None:
        """Raise ``Interrupted`` if ``agreed`` is true; by default, if a stop signal has arrived."""
        self._listen()  # Imported code can have replaced the signal handlers of this program.
        if self.requested if agreed is None else agreed:
            raise Interrupted

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.getsignal(number) for number in stop_signals()}
            self._listen()
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _listen(self) -> None:
        for number in self._before:
            if signal.getsignal(number) != self._request:
                signal.signal(number, self._request)

    def _request(self, number: int, _frame: FrameType | None) -> None:
        if self.requested and signal.Signals(number).name != "SIGHUP":
            raise Interrupted
        self.requested = True
