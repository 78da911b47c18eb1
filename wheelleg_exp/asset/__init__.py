"""Reads robots from USD and URDF into a plain description, and writes MJCF from it.

``convert`` makes one MJCF file; ``convert_cached`` keeps it in a cache, keyed by the content of every layer
that the USD stage is made of.

| module | what it offers |
|---|---|
| `conversion` | a USD or URDF file becomes an MJCF |
| `cache` | conversions kept by the content of what they were made of |
| `description` | a robot as plain data |
| `beside` | files of learned actuators and of the ground, which lie beside the MJCF |
| `usd`, `urdf` | read a robot |
| `mjcf` | writes it |
| `report` | what was read, assumed and left out |
| `findings`, `shape_findings` | what is odd about a file, as data, and the verdict |
| `values` | the model's numbers as plain JSON |
| `geometry`, `solids` | frames, volumes and inertias |
| `sources`, `allocation` | how much files may hold and take |
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.asset.robot_description import BaseMode, RobotDescription

if TYPE_CHECKING:
    from wheelleg_exp.asset.cache import CachedConversion, convert_cached, source_digest
    from wheelleg_exp.asset.conversion import Conversion, convert

_LAZY = {  # the USD and MuJoCo libraries are loaded with the first use
    "Conversion": "conversion",
    "convert": "conversion",
    "CachedConversion": "cache",
    "convert_cached": "cache",
    "source_digest": "cache",
}

__all__ = [
    "BaseMode",
    "CachedConversion",
    "Conversion",
    "Report",
    "RobotDescription",
    "convert",
    "convert_cached",
    "source_digest",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
