"""Threads: the environment variables that make CPU training repeatable, and how many cores there really are.

The variables must stand before torch is imported.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path

_CPUINFO = Path("/proc/cpuinfo")
PORTABLE_KERNELS, WIDE_KERNELS = "AVX2,STRICT", "AVX512,STRICT"


def matrix_kernels() -> str:
    """Return which of MKL's repeatable code paths is the fastest here: the wide one needs an Intel CPU with AVX-512.

    Both give the same bits at any number of threads. On other makes' CPUs MKL takes one path whatever it is told.
    """
    flags = first_processor().get("flags", "").split()
    wide = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"} <= set(flags)
    return WIDE_KERNELS if wide and is_intel() else PORTABLE_KERNELS


def is_intel() -> bool:
    """Return whether the CPU is one of Intel's, as far as the kernel tells."""
    return first_processor().get("vendor_id") == "GenuineIntel"


def first_processor() -> dict[str, str]:
    """Return what the kernel tells of the first processor; nothing where it has no such file."""
    try:
        text = _CPUINFO.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return {}
    lines = (line.partition(":") for line in text.partition("\n\n")[0].splitlines())
    return {name.strip(): value.strip() for name, _, value in lines}


_LOADAVG = Path("/proc/loadavg")
_SPINS, _SAMPLES = "20000", 3  # up to a millisecond of spinning


def spins() -> str:
    """Return how often OpenMP's idle threads look for work before they sleep.

    Those that sleep at once take twice as long for an update of many short operations. Those that spin are in the way
    of others that spin: two trainings beside each other would take four times as long. So they spin where nobody else
    computes just now.
    """
    try:
        running = []
        for _ in range(_SAMPLES):
            running.append(int(_LOADAVG.read_text(encoding="ascii").split()[3].partition("/")[0]))
            time.sleep(0.001)
    except (OSError, ValueError, IndexError):
        return "0"
    others = min(running) - 1
    return _SPINS if others + 2 <= (os.cpu_count() or 1) else "0"


# MKL_CBWR: the same matrix code path for every number of threads, so that thread counts change no number.
# OMP_WAIT_POLICY: idle threads sleep, after GOMP_SPINCOUNT; spinning ones make a busy machine many times slower.
VARIABLES = {"MKL_CBWR": matrix_kernels, "GOMP_SPINCOUNT": spins, "OMP_WAIT_POLICY": lambda: "PASSIVE"}
_chosen: set[str] = set()  # variables that are this program's choice, not the user's


def prepare_threads() -> bool:
    """Set the variables that are not set yet; how long threads spin only where nothing says how they wait.

    Returns:
        Whether they can still take effect: False when torch was imported before one of them was set.
    """
    missing = [name for name in VARIABLES if name not in os.environ]
    if "OMP_WAIT_POLICY" not in missing and "GOMP_SPINCOUNT" in missing:
        missing.remove("GOMP_SPINCOUNT")  # whoever says how threads wait has said how long
    os.environ.update({name: VARIABLES[name]() for name in missing})
    _chosen.update(missing)
    return not (missing and "torch" in sys.modules)


def share_cores() -> None:
    """Let threads of processes that this one starts sleep at once, because several of them compute at a time."""
    if "GOMP_SPINCOUNT" in _chosen:
        os.environ["GOMP_SPINCOUNT"] = "0"


def keep_kernels(recorded: Mapping[str, str]) -> None:
    """Let MKL go on with a run's code path where this program chose another, and this CPU has it.

    It must be called before MKL is first used, and importing tensordict uses it. A path that the user asks for stays.

    Args:
        recorded: the environment variables of the run.
    """
    kernels = recorded.get("MKL_CBWR")
    if "MKL_CBWR" in _chosen and kernels in (PORTABLE_KERNELS, matrix_kernels()):
        os.environ["MKL_CBWR"] = kernels


def own_environ() -> dict[str, str]:
    """Return the environment without what this program has chosen, for a process that chooses by itself.

    A variable that is handed on is the user's to that process: it would not go on with a run's kernels.
    """
    return {name: value for name, value in os.environ.items() if name not in _chosen}


def usable_cores() -> int:
    """Return how many cores this process can keep busy: those that it may run on, and no more than its quota pays.

    A container's limit (``docker run --cpus 2``) is such a quota.
    """
    from joblib import cpu_count  # which takes a while to import

    return int(cpu_count())
