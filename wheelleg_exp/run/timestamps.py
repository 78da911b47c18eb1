"""Convert times to UTC text for the manifest, and to local time for folder names."""

from __future__ import annotations

import re
from datetime import UTC, datetime

_FIRST_YEAR, _LAST_YEAR = 1970, 9998
_FOLDER = "%Y-%m-%d_%H-%M-%S"
_FOLDER_PATTERN = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d")


def utc_now() -> datetime:
    """Return the current time."""
    return datetime.now(UTC)


def utc_text(moment: datetime) -> str:
    """Return the time ``moment`` as ISO 8601 text in UTC, with microseconds and a ``Z``."""
    return moment.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def parse_utc(text: str) -> datetime:
    """Convert a text from ``utc_text`` back to a time; raise ValueError for a text in any other format."""
    moment = datetime.fromisoformat(text)
    if moment.tzinfo is None:
        raise ValueError(f"the time '{text}' has no time zone")
    if not _FIRST_YEAR <= moment.year <= _LAST_YEAR:  # `datetime.astimezone` can fail before 1970 and after 9998.
        raise ValueError(f"the time '{text}' is outside the years {_FIRST_YEAR} to {_LAST_YEAR}")
    return moment


def folder_text(moment: datetime) -> str:
    """Return a time as a folder name in local time, such as ``2026-01-31_17-05-09``; no time zone means local time."""
    local = moment if moment.tzinfo is None else moment.astimezone()
    return local.strftime(_FOLDER)


def folder_moment(name: str) -> datetime | None:
    """Return the start time in the name of a run directory, or None if the name contains no time."""
    match = _FOLDER_PATTERN.match(name)
    if match is None:
        return None
    try:
        return datetime.strptime(match.group(), _FOLDER).astimezone()
    except ValueError:
        return None
