"""Find rerun's command-line program, and rewrite a closed recording with it.

The rewritten file has few large chunks instead of thousands of small ones, and an index at its end.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

from wheelleg_exp.files import temporary_name
from wheelleg_exp.recording.reading.messages import HEADER_SIZE, MAGIC


def rerun_program() -> str:
    """Return rerun's own program; the script beside Python's would stand between us and it."""
    package = importlib.util.find_spec("rerun_cli")
    if package is not None and package.origin is not None:
        program = Path(package.origin).with_name("rerun")
        if program.exists():
            return str(program)
    return shutil.which("rerun") or "rerun"


_TIMEOUT_S = 600.0
_LONGEST = 200  # letters of rerun's own words


def optimize_recording(path: Path) -> str | None:
    """Rewrite a closed recording, a third of its size and quick to open; return None, or why that was not done.

    The content stays the same to the bit. It is done by rerun's own program, so that it takes no memory here. The file
    is the old one or the new one at any moment; where there is no room, or no program, it stays as it is, which lacks
    nothing but the index.
    """
    made = temporary_name(path)
    try:
        reason = _rewrite(path, made)
        if reason is None:
            with made.open("rb") as file:
                os.fsync(file.fileno())
            made.replace(path)
        return reason
    except subprocess.TimeoutExpired:
        return f"rerun did not end within {_TIMEOUT_S:.0f} s"
    except (OSError, subprocess.SubprocessError) as error:
        return getattr(error, "strerror", None) or type(error).__name__
    finally:
        with suppress(OSError):
            made.unlink(missing_ok=True)


def _rewrite(path: Path, made: Path) -> str | None:
    """Let rerun write ``made`` from ``path``; return why it is no recording."""
    command = [rerun_program(), "rrd", "optimize", str(path), "-o", str(made)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False, stdin=subprocess.DEVNULL)
    except FileNotFoundError:
        return "rerun's program is not there"
    if done.returncode == 0 and made.exists() and _is_recording(made):
        return None
    if shutil.disk_usage(path.parent).free < path.stat().st_size:
        return "there is no room for a second copy on the disk"
    lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
    return lines[-1][:_LONGEST] if lines else f"rerun ended with status {done.returncode}"


def _is_recording(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC and path.stat().st_size > HEADER_SIZE
