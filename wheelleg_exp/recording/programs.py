"""Where rerun's own program is."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path


def rerun_program() -> str:
    """Return rerun's own program; the script beside Python's would stand between us and it."""
    package = importlib.util.find_spec("rerun_cli")
    if package is not None and package.origin is not None:
        program = Path(package.origin).with_name("rerun")
        if program.exists():
            return str(program)
    return shutil.which("rerun") or "rerun"
