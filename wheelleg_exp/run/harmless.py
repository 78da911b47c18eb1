"""The settings that change no number, for a resume and for a comparison alike."""

from __future__ import annotations

# They change when and what is written, or how fast.
_HARMLESS = (
    ("agent", "max_iterations"),
    ("agent", "save_interval"),
    ("agent", "torch_threads"),
    ("agent", "logger"),
    ("env", "sim", "nthread"),
    ("recording",),
)


def decides(keys: tuple[str, ...]) -> bool:
    """Return whether the setting at these keys can change a number; what lies below harmless keys cannot either."""
    return not any(keys[: len(harmless)] == harmless for harmless in _HARMLESS)
