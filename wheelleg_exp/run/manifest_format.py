"""What a manifest must be before anything in it is believed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.run.inventory import is_inside
from wheelleg_exp.run.kinds import Maybe, misfits
from wheelleg_exp.run.timestamps import parse_utc

FORMAT = 2
VALUES_DIGESTED = 1  # the format whose digest is of the values and not of the bytes, if it has one
STATUSES = ("running", "finished", "interrupted", "failed")


_FILES = {str: {"sha256": str, "size": int}}
WRITER = {"pid": Maybe(int), "host": Maybe(str), "boot_id": Maybe(str), "start_ticks": Maybe(int)}  # a process
_PROCESS: dict[Any, Any] = {
    "error": Maybe({"type": Maybe(str), "message": Maybe(str)}),
    "ended": Maybe(str),
    "process": Maybe(WRITER),
    "failure": Maybe({"key": Maybe(str), "iteration": int, "message": str}),
    "versions": Maybe(dict),
    "hardware": Maybe(dict),
    "threads": Maybe(dict),
    "environment_variables": Maybe({str: str}),
}
_RESULTS = {"non_finite": Maybe({str: int})}
_RESUME = {
    "when": Maybe(str),
    "iteration": Maybe(int),
    "command": Maybe([str]),
    "overrides": Maybe([str]),
    "changes": Maybe([dict]),
    "why": Maybe([str]),
    "notes": Maybe([str]),
    "proved": Maybe(list),
    "differences": Maybe([dict]),
    "before": Maybe({**_PROCESS, "files": Maybe(_FILES)}),
    "files_to_write": Maybe({str: str}),
}
_MANIFEST = {
    **_PROCESS,
    "status": str,
    "task": str,
    "started": str,
    "results": _RESULTS,
    "resumes": [_RESUME],
    "additions": [{"kind": Maybe(str), "when": str, "files": _FILES, "results": Maybe(_RESULTS)}],
    "files": _FILES,
    "id": Maybe(str),
    "command": Maybe([str]),
    "working_directory": Maybe(str),
    "seeds": Maybe(list),
    "source": Maybe(dict),
    "engine": Maybe(dict),
    "config_dirs": Maybe([str]),
    "config_variables": Maybe({str: str}),
    "recording_unfinished": Maybe(str),
    "replay_of": Maybe(str),
    "replay": Maybe(dict),
    "ranks": Maybe({"world_size": int, "backend": Maybe(str), "seeds": Maybe(list)}),
}


def require_manifest(data: Any, path: Path) -> None:
    """Raise RunDirectoryError unless ``data``, read from ``path``, is a manifest of the format known here."""
    where = os.fspath(path)
    if not isinstance(data, dict) or "format" not in data:
        raise RunDirectoryError("this is not a run's manifest", where=where, expected="a mapping with 'format'")
    if type(data["format"]) is not int or data["format"] not in (VALUES_DIGESTED, FORMAT):
        raise RunDirectoryError(
            f"manifest format {data['format']!r} is not known here",
            where=where,
            expected=f"format {VALUES_DIGESTED} or {FORMAT}; a newer wheelleg_exp may read it",
        )
    for wrong in misfits(data, _MANIFEST):
        raise RunDirectoryError(f"broken manifest: '{wrong}' is missing or wrong", where=where)
    if data["status"] not in STATUSES:
        raise RunDirectoryError(
            f"status '{data['status']}' is not known",
            where=where,
            expected="one of " + ", ".join(STATUSES),
            nearest=nearest_name(data["status"], STATUSES),
        )
    _require_times(data, where)
    _require_inside(data, where)


def _require_times(data: dict[str, Any], where: str) -> None:
    times = [data["started"], *([data["ended"]] if data.get("ended") else [])]
    times += [entry["when"] for entry in data["additions"]]
    for text in times:
        try:
            parse_utc(text)
        except ValueError:
            raise RunDirectoryError(f"broken manifest: {text!r} is no time", where=where) from None


def _require_inside(data: dict[str, Any], where: str) -> None:
    tables = [data["files"], *(entry["files"] for entry in data["additions"])]
    for entry in data["resumes"]:
        tables += [entry.get("files_to_write") or {}, (entry.get("before") or {}).get("files") or {}]
    for name in (name for table in tables for name in table):
        if not is_inside(name):
            raise RunDirectoryError(f"the manifest names {name!r}, outside its directory", where=where)
