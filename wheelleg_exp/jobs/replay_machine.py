"""The machine of a replay: what it is, and the environment variables that the run had."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from typing import Any

from wheelleg_exp.run import environment

# Numbers and threads depend on these; which code is found, devices and this program's own folders are the machine's.
_PREFIXES = (
    *("MKL", "OMP", "GOMP", "KMP", "TBB", "OPENBLAS", "GOTO", "BLIS", "VECLIB", "NUMEXPR", "NPY", "NUMPY", "GLIBC"),
    *("ATEN", "ONEDNN", "DNNL", "TORCH", "PYTORCH", "TENSORDICT", "CUBLAS"),
)
_NUMERIC = re.compile(rf"({'|'.join(_PREFIXES)})_\w+|PYTHONHASHSEED")


def this_machine() -> dict[str, Any]:
    """Return what a manifest would say of this machine, before torch is imported and threads are set."""
    return {"versions": environment.versions(), "hardware": environment.hardware()}


def replay_environ(
    recorded: Mapping[str, str], environ: Mapping[str, str] | None = None, also: Collection[str] = ()
) -> dict[str, str]:
    """Return the environment of a process that computes as a run did.

    Variables on which numbers depend are those of the run, and are unset where it had none. All others stay: paths,
    devices, what is preloaded.

    Args:
        recorded: the variables that the run's manifest names.
        environ: the present environment, by default this process's own.
        also: names that are taken from the run as well, such as those that its config asks for.
    """
    present = dict(os.environ if environ is None else environ)
    kept = {name: value for name, value in present.items() if not _is_numeric(name, value)}
    taken = {name: value for name, value in recorded.items() if _is_numeric(name, value) or name in also}
    return kept | taken


def _is_numeric(name: str, value: str) -> bool:
    return _NUMERIC.fullmatch(name) is not None and not value.startswith(("/", "~"))
