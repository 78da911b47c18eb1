"""How much memory a config needs at least, held against the machine's before it is asked for.

Too much of it ends in errors that name no key, or in a process that the system kills without a word. What is needed
is a lower bound: what passes may still be too much.
"""

from __future__ import annotations

import os
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
