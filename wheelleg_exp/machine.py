"""The machine's limits: memory, and the cores and environment variables that CPU training uses.

Environment variables such as MKL_CBWR make CPU training repeatable, and must be set before torch is imported. A config
that needs more memory than the machine has is refused, because the system would kill the process.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from wheelleg_exp.errors import ConfigError, WheellegError

_LIMIT = Path("/sys/fs/cgroup/memory.max")
# Reading the default robot's file needs 573 MB of address space and a 62 MB data segment (measured on two cores).
_SPACE, _DATA = 5 * 2**27, 2**27
# Importing torch, MuJoCo, and USD needs 1.2 GB of address space (measured).
START_SPACE = 5 * 2**28
_UNITS = ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"))


def machine_memory() -> int:
    """Return the size of this machine's or container's memory in bytes."""
    found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = _LIMIT.read_text(encoding="ascii").strip()
    except OSError:
        return found
    return min(found, int(limit)) if limit.isdigit() else found


def require_memory(need: int, key: str, what: str) -> None:
    """Raise ConfigError for the config key ``key`` if the machine has fewer bytes of memory than ``need``."""
    total = machine_memory()
    if need > total:
        message = f"{what} take {shown_bytes(need)} of memory at least"
        raise ConfigError(message, key=key, expected=f"less than the {shown_bytes(total)} of this machine")


def used_memory(kind: str) -> int | None:
    """Return an entry of ``/proc/self/status``, such as ``VmData``, in bytes; None if unknown."""
    try:
        text = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return next(int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith(f"{kind}:"))
    except (OSError, StopIteration):
        return None


def require_room(space: int = _SPACE) -> None:
    """Raise WheellegError if ``ulimit -v`` or ``ulimit -d`` limits this process to fewer than ``space`` further bytes.

    Without free memory, the libraries USD, MuJoCo and torch crash without an error message.
    """
    for name, kind, least in (("RLIMIT_AS", "VmSize", space), ("RLIMIT_DATA", "VmData", _DATA)):
        used = used_memory(kind)
        if used is None:
            return
        import resource  # Windows lacks this module.

        limit = resource.getrlimit(getattr(resource, name))[0]
        if limit != resource.RLIM_INFINITY and limit - used < least:
            message = f"the limit leaves {shown_bytes(max(limit - used, 0))} of memory to this process"
            expected = f"at least {shown_bytes(least)}, so {shown_bytes(used + least)} in all"
            raise WheellegError(message, key=f"ulimit -{'v' if name == 'RLIMIT_AS' else 'd'}", expected=expected)


def shown_bytes(size: int) -> str:
    """Return a memory size as text with a unit such as GB or MB."""
    factor, unit = next((pair for pair in _UNITS if size >= pair[0]), _UNITS[-1])
    return f"{size / factor:,.3g} {unit}" if size < 1e15 else f"{size / factor:.1e} {unit}"


_CPUINFO = Path("/proc/cpuinfo")
PORTABLE_KERNELS, WIDE_KERNELS = "AVX2,STRICT", "AVX512,STRICT"


def matrix_kernels() -> str:
    """Return the faster of MKL's two reproducible code paths: the wide path needs an Intel CPU with AVX-512.

    MKL_CBWR makes MKL's results bitwise equal for any number of threads. MKL ignores it on CPUs that are not from
    Intel.
    """
    flags = first_processor().get("flags", "").split()
    wide = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"} <= set(flags)
    return WIDE_KERNELS if wide and is_intel() else PORTABLE_KERNELS


def is_intel() -> bool:
    """Return whether the operating system reports an Intel CPU."""
    return first_processor().get("vendor_id") == "GenuineIntel"


def first_processor() -> dict[str, str]:
    """Return what ``/proc/cpuinfo`` says about the first processor; an empty mapping without this file."""
    try:
        text = _CPUINFO.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return {}
    lines = (line.partition(":") for line in text.partition("\n\n")[0].splitlines())
    return {name.strip(): value.strip() for name, _, value in lines}


_LOADAVG = Path("/proc/loadavg")
_SPINS, _SAMPLES = "20000", 3  # 20000 turns of the busy loop take an idle OpenMP thread up to 1 ms.


def spins() -> str:
    """Return for how many turns OpenMP's idle threads wait in a busy loop before they sleep.

    Without a busy loop, a policy update with many short operations takes twice as long. With busy loops, two
    simultaneous trainings would take four times as long, so they are used only if enough cores are free.
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


# MKL_CBWR selects one code path for matrices, so that the number of threads does not change results.
# With OMP_WAIT_POLICY=PASSIVE, idle threads sleep after GOMP_SPINCOUNT turns of a busy loop.
VARIABLES: dict[str, Callable[[], str]] = {
    "MKL_CBWR": matrix_kernels,
    "GOMP_SPINCOUNT": spins,
    "OMP_WAIT_POLICY": lambda: "PASSIVE",
}
_chosen: set[str] = set()  # set by this program


def prepare_threads() -> bool:
    """Set the unset variables of ``VARIABLES``; return False if they have no effect because torch was imported."""
    missing = [name for name in VARIABLES if name not in os.environ]
    if "OMP_WAIT_POLICY" not in missing and "GOMP_SPINCOUNT" in missing:
        missing.remove("GOMP_SPINCOUNT")  # Respect the user's OMP_WAIT_POLICY, which defines how idle threads wait.
    os.environ.update({name: VARIABLES[name]() for name in missing})
    _chosen.update(missing)
    return not (missing and "torch" in sys.modules)


def share_cores() -> None:
    """Make idle threads of child processes sleep immediately, because several child processes compute at one time."""
    if "GOMP_SPINCOUNT" in _chosen:
        os.environ["GOMP_SPINCOUNT"] = "0"


def keep_kernels(recorded: Mapping[str, str]) -> None:
    """Use a run's recorded MKL code path before the first use of MKL, unless the CPU lacks it or the user chose one."""
    kernels = recorded.get("MKL_CBWR")
    if "MKL_CBWR" in _chosen and kernels in (PORTABLE_KERNELS, matrix_kernels()):
        os.environ["MKL_CBWR"] = kernels


def own_environ() -> dict[str, str]:
    """Return the environment for a child process, without variables that this program, not the user, has set."""
    return {name: value for name, value in os.environ.items() if name not in _chosen}


def usable_cores() -> int:
    """Return the number of cores that this process can use: its CPU affinity, limited by a container's CPU quota."""
    from joblib import cpu_count  # slow to import

    return int(cpu_count())
