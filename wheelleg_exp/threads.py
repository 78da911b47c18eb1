"""Threads: the environment variables that make CPU training repeatable, and how many cores there really are.

The variables must stand before torch is imported.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

_CPUINFO = Path("/proc/cpuinfo")
PORTABLE_KERNELS, WIDE_KERNELS = "AVX2,STRICT", "AVX512,STRICT"


def matrix_kernels() -> str:
    """Return which of MKL's repeatable code paths is the fastest here: the wide one needs an Intel CPU with AVX-512.

    Both give the same bits at any number of threads. On other makes' CPUs MKL takes one path whatever it is told.
    """
    flags = _first_processor().get("flags", "").split()
    wide = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"} <= set(flags)
    return WIDE_KERNELS if wide and is_intel() else PORTABLE_KERNELS


def is_intel() -> bool:
    """Return whether the CPU is one of Intel's, as far as the kernel tells."""
    return _first_processor().get("vendor_id") == "GenuineIntel"


def _first_processor() -> dict[str, str]:
    """Return what the kernel tells of the first processor; nothing where it has no such file."""
    facts = {}
    try:
        with _CPUINFO.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if not line.strip():
                    break
                name, _, value = line.partition(":")
                facts[name.strip()] = value.strip()
    except OSError:
        return {}
    return facts


# MKL_CBWR: the same matrix code path for every number of threads, so that thread counts change no number.
# OMP_WAIT_POLICY: idle threads sleep; spinning ones make a busy machine many times slower.
VARIABLES = {"MKL_CBWR": matrix_kernels(), "OMP_WAIT_POLICY": "PASSIVE"}
_chosen: set[str] = set()  # variables that are this program's choice, not the user's

_CGROUPS = Path("/sys/fs/cgroup")
_PROC_CGROUP = Path("/proc/self/cgroup")


def prepare_threads() -> bool:
    """Set the variables that are not set yet.

    Returns:
        Whether they can still take effect: False when torch was imported before one of them was set.
    """
    late = "torch" in sys.modules and any(name not in os.environ for name in VARIABLES)
    for name, value in VARIABLES.items():
        if name not in os.environ:
            os.environ[name] = value
            _chosen.add(name)
    return not late


def keep_kernels(recorded: Mapping[str, str]) -> None:
    """Let MKL go on with a run's code path where this program chose another, and this CPU has it.

    It must be called before the first product. A path that the user asks for stays.

    Args:
        recorded: the environment variables of the run.
    """
    kernels = recorded.get("MKL_CBWR")
    if "MKL_CBWR" in _chosen and kernels in (PORTABLE_KERNELS, matrix_kernels()):
        os.environ["MKL_CBWR"] = kernels


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
