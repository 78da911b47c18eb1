"""The environment variables that make CPU training reproducible; they must stand before torch is imported."""

from __future__ import annotations

import os
import sys

# MKL_CBWR: the same matrix code path for every number of threads, so that thread counts change no number.
# OMP_WAIT_POLICY: idle threads sleep; spinning ones make a busy machine many times slower.
VARIABLES = {"MKL_CBWR": "AVX2,STRICT", "OMP_WAIT_POLICY": "PASSIVE"}


def prepare_threads() -> bool:
    """Set the variables that are not set yet.

    Returns:
        Whether they can still take effect: False when torch was imported before one of them was set.
    """
    late = "torch" in sys.modules and any(name not in os.environ for name in VARIABLES)
    for name, value in VARIABLES.items():
        os.environ.setdefault(name, value)
    return not late
