"""Points in time: UTC in the manifest, local time in the names of folders."""

from __future__ import annotations

import re
from datetime import UTC, datetime

_FIRST_YEAR, _LAST_YEAR = 1970, 9998
_FOLDER = "%Y-%m-%d_%H-%M-%S"
_FOLDER_PATTERN = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d")


def utc_now() -> datetime:
    """Return the present moment."""
    return datetime.now(UTC)


def utc_text(moment: datetime) -> str:
    """Return ``moment`` as ISO 8601 text in UTC, with microseconds and a ``Z``."""
    return moment.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def parse_utc(text: str) -> datetime:
    """Return the moment that ``utc_text`` wrote (ValueError for other text)."""
    moment = datetime.fromisoformat(text)
    if moment.tzinfo is None:
        raise ValueError(f"'{text}' has no time zone")
    if not _FIRST_YEAR <= moment.year <= _LAST_YEAR:  # beyond these no time zone can be changed
        raise ValueError(f"'{text}' is in no year of a computer")
    return moment


def folder_text(moment: datetime) -> str:
    """Return ``moment`` in local time as a folder's name, ``2026-01-31_17-05-09``; a naive one is local."""
    local = moment if moment.tzinfo is None else moment.astimezone()
    return local.strftime(_FOLDER)


def folder_moment(name: str) -> datetime | None:
    """Return the moment that a run folder's name begins with, or None."""
    match = _FOLDER_PATTERN.match(name)
    if match is None:
        return None
    try:
        return datetime.strptime(match.group(), _FOLDER).astimezone()
    except ValueError:
        return None
