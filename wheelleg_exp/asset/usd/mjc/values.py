"""Reads attributes of MuJoCo's schemas: only what is authored, in the types that MJCF has for it.

USD writes what differs from the schema's default, so that one end of a range may be missing: it is 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pxr import Usd

from wheelleg_exp.asset.usd.stage import Stage

Attribute = str | int | float | bool | tuple[float, ...]
EXACT = {"wind": 3, "magnetic": 3, "rgba": 4}  # numbers that MuJoCo wants
LONGEST = {  # numbers that MuJoCo takes, or fewer
    "solref": 2,
    "solreflimit": 2,
    "solreffriction": 2,
    "o_solref": 2,
    "springdamper": 2,
    "springlength": 2,
    "solimp": 5,
    "solimplimit": 5,
    "solimpfriction": 5,
    "o_solimp": 5,
    "o_friction": 5,
    "gear": 6,
    "gainprm": 10,
    "biasprm": 10,
    "dynprm": 10,
}
WORDS = {"cone": {"pyramidal", "elliptic"}}


def numbers(stage: Stage, prim: Usd.Prim, name: str, became: str) -> tuple[float, ...] | None:
    """Return an array's numbers, None when it is not authored or empty."""
    value = stage.ledger.read(prim, name, became)
    found = None if value is None else tuple(float(v) for v in np.atleast_1d(value))
    return found if found and _fits(stage, prim, name, became, found) else None


def indices(stage: Stage, prim: Usd.Prim, name: str, became: str) -> list[int]:
    """Return an array of integers, [] when it is not authored."""
    return [int(v) for v in numbers(stage, prim, name, became) or ()]


def attributes(stage: Stage, prim: Usd.Prim, names: Mapping[str, str]) -> dict[str, Attribute]:
    """Return what is authored of ``names`` (USD name: MJCF attribute), in the order of ``names``.

    Values that are not finite stand for MuJoCo's default and are left away.
    """
    found: dict[str, Attribute] = {}
    for name, became in names.items():
        value = stage.ledger.read(prim, name, became)
        plain = None if value is None else _plain(value)
        if plain is not None and _fits(stage, prim, name, became, plain):
            found[became] = plain
    return found


def _fits(stage: Stage, prim: Usd.Prim, name: str, became: str, value: Attribute) -> bool:
    """Return whether MuJoCo takes a value; else leave it out and say so."""
    if isinstance(value, tuple) and len(value) != EXACT.get(became, len(value)):
        reason = f"MuJoCo's {became} has {EXACT[became]} numbers, not {len(value)}"
    elif isinstance(value, tuple) and len(value) > LONGEST.get(became, len(value)):
        reason = f"MuJoCo's {became} has {LONGEST[became]} numbers, not {len(value)}"
    elif isinstance(value, str) and value not in WORDS.get(became, {value}):
        reason = f"MuJoCo's {became} is one of {', '.join(sorted(WORDS[became]))}"
    else:
        return True
    stage.ledger.leave(prim.GetPath(), name, reason, value)
    stage.ledger.warn(f"{prim.GetPath()}: {name} was left out: {reason}")
    return False


def _plain(value: Any) -> Attribute | None:
    if isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    array = tuple(float(v) for v in value)
    return array if array and all(math.isfinite(v) for v in array) else None


def limits(stage: Stage, prim: Usd.Prim, stem: str, switch: str, became: str) -> dict[str, Attribute]:
    """Return a range and whether it holds, as MJCF's two attributes.

    Args:
        stage: the open stage.
        prim: where it stands.
        stem: ``mjc:ctrlRange`` of ``mjc:ctrlRange:min`` and ``:max``.
        switch: the token ``auto``, ``true`` or ``false``, such as ``mjc:ctrlLimited``.
        became: the MJCF attribute of the range; that of the switch is ``ctrllimited`` for ``ctrlrange``.
    """
    switched = became.removesuffix("range") + "limited"
    ends = [stage.ledger.read(prim, f"{stem}:{end}", became) for end in ("min", "max")]
    token = stage.ledger.read(prim, switch, switched) or "auto"
    found: dict[str, Attribute] = {}
    low, high = (0.0 if end is None else float(end) for end in ends)
    proper = low < high and math.isfinite(low) and math.isfinite(high)
    if proper:
        found[became] = (low, high)
    if token == "false" and proper:
        found[switched] = False
    elif token == "true" and not proper:
        stage.ledger.warn(f"{prim.GetPath()}: {switch} is true, but {stem} holds no range; left unlimited")
    return found


def leave(stage: Stage, prim: Usd.Prim, name: str, reason: str) -> None:
    """Name an authored attribute that has no place in the model, unless something was made of it already."""
    value = stage.ledger.read(prim, name)
    if value is not None and not stage.ledger.knows(prim.GetPath(), name):
        stage.ledger.leave(prim.GetPath(), name, reason, value)
