"""Which process writes a run, and whether it still lives."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_PROC = Path("/proc")


def this_process() -> dict[str, Any]:
    """Return what names this process beyond doubt: pid, host, boot id, and its start in clock ticks.

    A pid alone is used again by later processes; with the boot and the start it is not. Where the system
    does not tell, the last two are None.
    """
    pid = os.getpid()
    return {"pid": pid, "host": platform.node(), "boot_id": _boot_id(), "start_ticks": _start_ticks(pid)}


def is_alive(recorded: Mapping[str, Any]) -> bool | None:
    """Return whether the process that ``this_process`` described lives, or None when it cannot be told.

    It cannot be told from another host, and on systems that do not show processes.
    """
    pid = recorded.get("pid")
    if not isinstance(pid, int) or pid <= 0 or recorded.get("host") != platform.node():
        return None
    if recorded.get("boot_id") != _boot_id():
        return False
    if (_PROC / "self" / "stat").exists():
        ticks = _start_ticks(pid)
        return ticks is not None and ticks == recorded.get("start_ticks", ticks)
    return _answers_signal(pid)


def _answers_signal(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _boot_id() -> str | None:
    try:
        return (_PROC / "sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return None


def _start_ticks(pid: int) -> int | None:
    """Return field 22 of ``/proc/<pid>/stat``; None when there is no such process, or only its remains."""
    try:
        text = (_PROC / str(pid) / "stat").read_text(errors="replace")
    except OSError:
        return None
    # The name in parentheses may hold anything, so count from the last parenthesis (proc(5)).
    fields = text.rpartition(")")[2].split()
    return None if fields[0] in "ZX" else int(fields[19])
