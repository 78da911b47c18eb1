"""What of the source is kept with a run, in words for the console."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_SHOWN = 5


def source_lines(content: Mapping[str, Any]) -> list[str]:
    """Return one line for each repository or folder of a ``git.json``, and one more for those that leave files out.

    Args:
        content: what ``restore.load_source`` returns.
    """
    lines = []
    for record in (content, *content["others"]):
        lines.append(_line(record))
        if record["refused"]:
            lines.append(f"warning: left out of the source of {record['root']}: {_refused(record['refused'])}")
    return lines


def _line(record: Mapping[str, Any]) -> str:
    if record["patch"] is not None:
        return f"source: {_kept(record)}"
    if record["status"] == "installed":
        return f"source: {record['note']}"
    return f"warning: the source is not kept: {record['note']}"


def _kept(record: Mapping[str, Any]) -> str:
    patch, count = record["patch"], len(record["changed"])
    files = f"{count} file{'' if count == 1 else 's'}"
    if record["commit"] is None:
        where = "has no commit yet" if record["status"] == "no_commits" else "is in no repository that git reads"
        return f"{record['root']} {where}; {files}, kept in source/{patch}"
    place = f"commit {record['commit'][:10]} of {record['root']}"
    branch = f" on {record['branch']}" if record["branch"] else ", no branch"
    if not record["dirty"]:
        return f"{place}{branch}, clean"
    untracked = f" ({len(record['untracked'])} untracked)" if record["untracked"] else ""
    return f"{place}{branch}, with changes: {files}{untracked}, kept in source/{patch}"


def _refused(entries: list[Mapping[str, str]]) -> str:
    shown = [f"{entry['path']!r} ({entry['reason']})" for entry in entries[:_SHOWN]]
    more = len(entries) - _SHOWN
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
