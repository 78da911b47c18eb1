"""Threads: the environment variables that make CPU training repeatable, and how many cores there really are.

The variables must stand before torch is imported.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

# MKL_CBWR: the same matrix code path for every number of threads, so that thread counts change no number.
# OMP_WAIT_POLICY: idle threads sleep; spinning ones make a busy machine many times slower.
VARIABLES = {"MKL_CBWR": "AVX2,STRICT", "OMP_WAIT_POLICY": "PASSIVE"}

_CGROUPS = Path("/sys/fs/cgroup")
_PROC_CGROUP = Path("/proc/self/cgroup")


def prepare_threads() -> bool:
    """Set the variables that are not set yet.

    Returns:
        Whether they can still take effect: False when torch was imported before one of them was set.
    """
    late = "torch" in sys.modules and any(name not in os.environ for name in VARIABLES)
    for name, value in VARIABLES.items():
        os.environ.setdefault(name, value)
    return not late


def usable_cores() -> int:
    """Return how many cores this process can keep busy: those that it may run on, and no more than its quota pays."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cpu_quota()
    return allowed if quota is None else max(1, min(allowed, math.ceil(quota)))


def cpu_quota() -> float | None:
    """Return the CPU time that the process's control group gets, in cores; None without a limit.

    A container's limit (``docker run --cpus 2``) is such a quota; the smallest of a group and those around it counts.
    """
    quotas = [quota for folder in _groups() if (quota := _quota(folder)) is not None]
    return min(quotas, default=None)


def _groups() -> Iterator[Path]:
    """Yield the folders of the process's control groups and of those around them, version 2 and version 1."""
    for line in _text(_PROC_CGROUP).splitlines():
        _, controllers, path = line.split(":", 2)
        version1 = "cpu" in controllers.split(",")
        if controllers and not version1:
            continue
        bases = [_CGROUPS / name for name in ("cpu", controllers)] if version1 else [_CGROUPS]
        inner = Path(path.lstrip("/"))
        for base in bases:
            yield from (base / place for place in (inner, *inner.parents))


def _quota(folder: Path) -> float | None:
    """Return the quota of one group: ``cpu.max`` (``200000 100000``), or ``cpu.cfs_quota_us`` in version 1."""
    words = _text(folder / "cpu.max").split()
    if not words:
        words = [_text(folder / f"cpu.cfs_{name}_us").strip() for name in ("quota", "period")]
    try:
        quota, period = map(int, words)
    except ValueError:  # "max", or no such file
        return None
    return quota / period if quota > 0 and period > 0 else None


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
