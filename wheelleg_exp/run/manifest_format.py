"""What a manifest must be before anything in it is believed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.run.inventory import is_inside
from wheelleg_exp.run.timestamps import parse_utc

FORMAT = 1
STATUSES = ("running", "finished", "interrupted", "failed")

_REQUIRED: dict[str, Any] = {
    "status": str,
    "task": str,
    "started": str,
    "ended": (str, type(None)),
    "results": dict,
    "resumes": list,
    "additions": list,
    "files": dict,
}


def require_manifest(data: Any, path: Path) -> None:
    """Raise RunDirectoryError unless ``data``, read from ``path``, is a manifest of the format known here."""
    where = os.fspath(path)
    if not isinstance(data, dict) or "format" not in data:
        raise RunDirectoryError("this is not a run's manifest", where=where, expected="a mapping with 'format'")
    if data["format"] != FORMAT:
        raise RunDirectoryError(
            f"manifest format {data['format']!r} is not known here",
            where=where,
            expected=f"format {FORMAT}; a newer wheelleg_exp may read it",
        )
    for key, kind in _REQUIRED.items():
        if not isinstance(data.get(key), kind):
            raise RunDirectoryError(f"broken manifest: '{key}' is missing or wrong", where=where)
    if data["status"] not in STATUSES:
        raise RunDirectoryError(
            f"status '{data['status']}' is not known",
            where=where,
            expected="one of " + ", ".join(STATUSES),
            nearest=nearest_name(data["status"], STATUSES),
        )
    _require_times(data, where)
    _require_records(data, where)


def _require_times(data: dict[str, Any], where: str) -> None:
    times = [data["started"], *([data["ended"]] if data["ended"] else [])]
    times += [entry.get("when") if isinstance(entry, dict) else None for entry in data["additions"]]
    for text in times:
        try:
            parse_utc(text)
        except (TypeError, ValueError):
            raise RunDirectoryError(f"broken manifest: {text!r} is no time", where=where) from None


def _require_records(data: dict[str, Any], where: str) -> None:
    for files in (data["files"], *(entry.get("files") for entry in data["additions"])):
        if not isinstance(files, dict):
            raise RunDirectoryError("broken manifest: 'files' is missing or wrong", where=where)
        for name, record in files.items():
            if not is_inside(name):
                raise RunDirectoryError(f"the manifest names '{name}', outside its directory", where=where)
            if not isinstance(record, dict) or set(record) != {"sha256", "size"}:
                raise RunDirectoryError(f"broken manifest: no digest of '{name}'", where=where)
