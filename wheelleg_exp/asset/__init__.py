"""Read a USD or URDF file into a robot description, and write the description as an MJCF file."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.asset.robot_description import BaseMode, RobotDescription

if TYPE_CHECKING:
    from wheelleg_exp.asset.conversion_cache import CachedConversion, convert_cached, source_digest
    from wheelleg_exp.asset.convert_robot import Conversion, convert

_LAZY = {  # Each function is imported at its first use, because loading the USD and MuJoCo libraries takes a second.
    **dict.fromkeys(("Conversion", "convert"), "convert_robot"),
    **dict.fromkeys(("CachedConversion", "convert_cached", "source_digest"), "conversion_cache"),
}

__all__ = [
    "BaseMode", "CachedConversion", "Conversion", "Report", "RobotDescription", "convert", "convert_cached",
    "source_digest",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
