"""The machine's limits: memory, and the cores and environment variables that CPU training uses.

The variables must be set before torch is imported: they make CPU training repeatable. A memory requirement is a
lower bound, so that a config that cannot fit is refused by its key before the system kills the process.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from wheelleg_exp.errors import ConfigError, WheellegError

_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of a container
# Bytes of address space and of data that reading the stock robot needs (measured: 573 MB and 62 MB on two cores).
_SPACE, _DATA = 5 * 2**27, 2**27
START_SPACE = 5 * 2**28  # bytes of address space that importing torch, MuJoCo and USD needs (measured: 1.2 GB)
_UNITS = ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"))


def machine_memory() -> int:
    """Return the bytes of memory that this machine, or the container, has."""
    found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = _LIMIT.read_text(encoding="ascii").strip()
    except OSError:
        return found
    return min(found, int(limit)) if limit.isdigit() else found


def require_memory(need: int, key: str, what: str) -> None:
    """Refuse what cannot fit.

    Args:
        need: bytes that it needs at least.
        key: the config key that says how much.
        what: what needs them, in words.

    Raises:
        ConfigError: the machine has less.
    """
    there = machine_memory()
    if need > there:
        message = f"{what} take {shown_bytes(need)} of memory at least"
        raise ConfigError(message, key=key, expected=f"less than the {shown_bytes(there)} of this machine")


def used_memory(kind: str) -> int | None:
    """Return a size of this process in bytes by its name in ``/proc/self/status``; None where the system has none."""
    try:
        text = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return next(int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith(f"{kind}:"))
    except (OSError, StopIteration):
        return None


def require_room(space: int = _SPACE) -> None:
    """Refuse limits that leave less than ``space`` bytes to this process: USD, MuJoCo and torch crash without memory.

    Raises:
        WheellegError: ``ulimit -v`` or ``ulimit -d`` is too low.
    """
    for name, kind, least in (("RLIMIT_AS", "VmSize", space), ("RLIMIT_DATA", "VmData", _DATA)):
        used = used_memory(kind)
        if used is None:
            return
        import resource  # Windows has none

        limit = resource.getrlimit(getattr(resource, name))[0]
        if limit != resource.RLIM_INFINITY and limit - used < least:
            message = f"the limit leaves {shown_bytes(max(limit - used, 0))} of memory to this process"
            expected = f"at least {shown_bytes(least)}, so {shown_bytes(used + least)} in all"
            raise WheellegError(message, key=f"ulimit -{'v' if name == 'RLIMIT_AS' else 'd'}", expected=expected)


def shown_bytes(size: int) -> str:
    """Return a size in GB or MB with three digits."""
    factor, unit = next((pair for pair in _UNITS if size >= pair[0]), _UNITS[-1])
    return f"{size / factor:,.3g} {unit}" if size < 1e15 else f"{size / factor:.1e} {unit}"


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
