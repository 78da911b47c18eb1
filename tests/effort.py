"""Measure the cost of code as a count of Python instructions, which does not depend on the load of the machine."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from itertools import count
from types import CodeType, FrameType
from typing import Any


def bytecodes(work: Callable[[], Any]) -> int:
    """Return the number of Python instructions that ``work`` runs in this thread; a call into C counts as one."""
    counter = count()
    if sys.version_info >= (3, 12):  # Its tracing omits code in its first run.
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
        if threading.get_ident() == here:  # The events come from all threads.
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
