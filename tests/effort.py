"""What work costs, counted and not timed: a count is the same however busy the machine is."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from itertools import count
from types import CodeType, FrameType
from typing import Any


def bytecodes(work: Callable[[], Any]) -> int:
    """Return how many instructions of Python ``work`` takes in this thread; what C does within one counts as one."""
    counter = count()
    if sys.version_info >= (3, 12):  # whose tracing leaves the instructions of code out that runs for the first time
        _monitored(work, counter)
    else:
        _traced(work, counter)
    return next(counter)


def _traced(work: Callable[[], Any], counter: count[int]) -> None:
    def trace(frame: FrameType, event: str, argument: Any) -> Callable[..., Any]:
        frame.f_trace_lines, frame.f_trace_opcodes = False, True
        if event == "opcode":
            next(counter)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)


def _monitored(work: Callable[[], Any], counter: count[int]) -> None:
    here = threading.get_ident()

    def seen(code: CodeType, offset: int) -> None:
        if threading.get_ident() == here:  # the events are those of all threads
            next(counter)

    tool, events = sys.monitoring.PROFILER_ID, sys.monitoring.events
    sys.monitoring.use_tool_id(tool, "effort")
    sys.monitoring.register_callback(tool, events.INSTRUCTION, seen)
    sys.monitoring.set_events(tool, events.INSTRUCTION)
    try:
        work()
    finally:
        sys.monitoring.set_events(tool, events.NO_EVENTS)
        sys.monitoring.free_tool_id(tool)
