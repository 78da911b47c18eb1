"""Format numbers, durations, sizes, and config values for the readers of a report."""

from __future__ import annotations

import math
from collections.abc import Mapping

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LONGEST = 160  # A report shows at most this number of characters of a value.


def number(value: object, digits: int = 3) -> str:
    """Format a number with ``digits`` significant digits and, if possible, without an exponent; None becomes a dash."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return "–" if value is None else brief(value)
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ").replace("-", "−")
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "infinite"
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}×10".replace("-", "−") + str(int(exponent)).translate(_RAISED)
    places = max(0, digits - 1 - (math.floor(math.log10(abs(value))) if value else 0))
    return f"{value:.{places}f}".replace("-", "−")


def numbers(figures: Mapping[str, object]) -> dict[str, object]:
    """Replace the text ``nan`` in figures from a JSON file by None, because JSON has no NaN."""
    found: dict[str, object] = {}
    for key, value in figures.items():
        is_nan = value == "nan" or (isinstance(value, float) and math.isnan(value))
        found[key] = numbers(value) if isinstance(value, Mapping) else None if is_nan else value
    return found


def exact(value: object) -> str:
    """Format a number with up to six digits, such as ``5``, ``0.07``, ``−50``; None becomes a dash."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return "–" if value is None else brief(value)
    return f"{value:.6g}".replace("-", "−")


def percent(share: object) -> str:
    """Format a share, 0 to 1, as a percentage; a share below 1 is never rounded up to 100 %."""
    if isinstance(share, bool) or not isinstance(share, (int, float)) or not math.isfinite(share):
        return "–"
    value = 100.0 * share
    if value == round(value):
        return f"{value:.0f} %"
    shown = min(max(round(value, 1), 0.1), 99.9) if 0 < value < 100 else round(value, 1)
    return f"{shown:.1f} %".replace("-", "−")


def duration(seconds: object) -> str:
    """Format a duration in its two largest units, such as hours and minutes."""
    if isinstance(seconds, bool) or not isinstance(seconds, (int, float)) or not 0 <= seconds < 1e12:
        return "–"
    if seconds < 60:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{number(float(seconds), 2)} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours < 48 else f"{hours // 24} d {hours % 24} h"


def size(octets: object) -> str:
    """Format a file size in bytes, kB, MB, or GB (powers of 1000)."""
    if isinstance(octets, bool) or not isinstance(octets, (int, float)) or not math.isfinite(octets):
        return "–"
    value = float(octets)
    for unit in ("B", "kB", "MB"):
        if abs(value) < 1000:
            return f"{value:.0f} {unit}" if unit == "B" or value >= 100 else f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"


def moment(text: object) -> str:
    """Return a manifest's time to the second: ``2026-01-31 17:05:09 UTC``."""
    return "–" if not isinstance(text, str) or len(text) < 19 else f"{text[:10]} {text[11:19]} UTC"


def brief(value: object) -> str:
    """Format a config value as YAML on one line; a long value is truncated."""
    text = plain(value)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def plain(value: object) -> str:
    """Return a config value as YAML on one line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(plain(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {plain(item)}" for key, item in value.items()) + "}"
    return str(value)


def counted(count: int, one: str) -> str:
    """Return a number with a noun: ``1 episode``, ``2 episodes``."""
    return f"{number(count)} {one if count == 1 else one + 's'}"


def spoken(name: str) -> str:
    """Return an identifier as words: ``base_contact`` becomes ``base contact``."""
    return name.replace("_", " ").strip() or name


def capital(text: str) -> str:
    """Return ``text`` with a capital first letter."""
    return text[:1].upper() + text[1:]
