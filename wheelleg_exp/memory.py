"""How much memory a config needs at least, held against the machine's before it is asked for.

Too much of it ends in errors that name no key, or in a process that the system kills without a word. What is needed
is a lower bound: what passes may still be too much.
"""

from __future__ import annotations

import os
from pathlib import Path

from wheelleg_exp.errors import ConfigError

_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of a container
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
        message = f"{what} take {_shown(need)} of memory at least"
        raise ConfigError(message, key=key, expected=f"less than the {_shown(there)} of this machine")


def _shown(size: int) -> str:
    factor, unit = next((pair for pair in _UNITS if size >= pair[0]), _UNITS[-1])
    return f"{size / factor:,.3g} {unit}" if size < 1e15 else f"{size / factor:.1e} {unit}"
