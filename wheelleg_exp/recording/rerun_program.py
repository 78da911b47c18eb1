"""Run Rerun's command-line program, which rewrites recordings."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

from wheelleg_exp.files import temporary_name
from wheelleg_exp.recording.rrd_file import HEADER_SIZE, MAGIC

_TIMEOUT_S = 600.0
_LONGEST_REASON = 200


def rerun_program() -> str:
    """Return the path of Rerun's executable, not of the Python script that starts it."""
    package = importlib.util.find_spec("rerun_cli")
    if package is not None and package.origin is not None:
        program = Path(package.origin).with_name("rerun")
        if program.exists():
            return str(program)
    return shutil.which("rerun") or "rerun"


def run_rerun(*words: str) -> tuple[str | None, list[str]]:
    """Run ``rerun rrd``; return the reason why the command failed, or None, and the lines that it logged."""
    command = [rerun_program(), "rrd", *words]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False, stdin=subprocess.DEVNULL)
    except FileNotFoundError:
        return "Rerun's program is missing", []
    except subprocess.TimeoutExpired:
        return f"rerun did not finish within {_TIMEOUT_S:.0f} s", []
    lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
    if done.returncode == 0:
        return None, lines
    return lines[-1][:_LONGEST_REASON] if lines else f"rerun exited with status {done.returncode}", lines


def optimize_recording(path: Path) -> str | None:
    """Compress a closed recording to about a third of its size. Return the reason if compression failed, else None.

    The file is replaced atomically. Without Rerun's program or enough disk space, it stays unchanged, without an index.
    """
    rewritten = temporary_name(path)
    try:
        reason, _ = run_rerun("optimize", str(path), "-o", str(rewritten))
        if reason is None and not _is_recording(rewritten):
            reason = "rerun wrote nothing"
        if reason is None:
            with rewritten.open("rb") as file:
                os.fsync(file.fileno())
            rewritten.replace(path)
        elif shutil.disk_usage(path.parent).free < path.stat().st_size:
            return "the disk has no room for a second copy"
        return reason
    except (OSError, subprocess.SubprocessError) as error:
        return getattr(error, "strerror", None) or type(error).__name__
    finally:
        with suppress(OSError):
            rewritten.unlink(missing_ok=True)


def _is_recording(path: Path) -> bool:
    if not path.exists():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC and path.stat().st_size > HEADER_SIZE
