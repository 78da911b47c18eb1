"""Which axes a joint leaves free, and where it locks the others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pxr import Usd

from wheelleg_exp.asset.description import Vec3
from wheelleg_exp.asset.geometry import Array, Frame
from wheelleg_exp.asset.usd.stage import Stage, schemas
from wheelleg_exp.asset.usd.units import endless

UNIT: dict[str, Vec3] = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
SLIDES, TURNS = ("transX", "transY", "transZ"), ("rotX", "rotY", "rotZ")


@dataclass(frozen=True)
class FreeAxis:
    """One axis that a joint leaves free, in the joint's frame. ``token`` is its name in drives and limits."""

    kind: Literal["hinge", "slide", "ball"]
    axis: Vec3
    token: str
    suffix: str = ""


def single_axis(stage: Stage, prim: Usd.Prim, angular: bool) -> list[FreeAxis]:
    """Return the axis of a revolute or prismatic joint; an empty or unknown name is X, as in PhysX."""
    token = "angular" if angular else "linear"
    return [FreeAxis("hinge" if angular else "slide", UNIT[axis_name(stage, prim)], token)]


def axis_name(stage: Stage, prim: Usd.Prim) -> str:
    """Return X, Y or Z."""
    name = stage.ledger.read(prim, "physics:axis", "axis")
    if name in UNIT:
        return str(name)
    what = "unknown" if name else "not given"
    stage.ledger.assume(prim.GetPath(), f"physics:axis is {what}: X", repr(name))
    return "X"


def ball_axes(stage: Stage, prim: Usd.Prim) -> list[FreeAxis]:
    """Return what a spherical joint leaves free: a ball, or a hinge when both cone angles are zero."""
    angles = [stage.ledger.read(prim, f"physics:coneAngle{i}Limit", "range of the ball") for i in (0, 1)]
    if angles == [0, 0]:
        stage.ledger.assume(prim.GetPath(), "a spherical joint whose cone is closed turns about its axis", "hinge")
        return [FreeAxis("hinge", UNIT[axis_name(stage, prim)], "twist")]
    stage.ledger.read(prim, "physics:axis", "the ball's cone axis; a ball has none")
    return [FreeAxis("ball", UNIT["X"], "rot")]


def generic_axes(stage: Stage, prim: Usd.Prim) -> tuple[list[FreeAxis], Frame]:
    """Return what a generic joint leaves free, slides before hinges, and where the locked axes stand.

    An axis is locked when its low limit is above its high one (at 0), or equal to it (there). Three rotations are a
    ball where none of them has limits, a drive, a state or friction of its own, which a ball cannot hold.
    """
    free, offset = [], Frame.identity()
    for token in (*SLIDES, *TURNS):
        low, high = _limits(stage, prim, token)
        if low is not None and high is not None and low >= high:
            offset = offset @ _at(stage, prim, token, low if low == high else 0.0)
            continue
        kind: Literal["hinge", "slide"] = "slide" if token in SLIDES else "hinge"
        free.append(FreeAxis(kind, UNIT[token[-1]], token, f"_{token}"))
    turns = [axis for axis in free if axis.kind == "hinge"]
    if len(turns) == 3 and not any(_limited(stage, prim, axis.token) or _own(prim, axis.token) for axis in turns):
        free = [axis for axis in free if axis.kind == "slide"]
        free.append(FreeAxis("ball", UNIT["X"], "rot", "_rot" if free else ""))
    return free, offset


def _limits(stage: Stage, prim: Usd.Prim, token: str) -> tuple[float | None, float | None]:
    low = stage.ledger.read(prim, f"limit:{token}:physics:low", "the choice of free axes")
    high = stage.ledger.read(prim, f"limit:{token}:physics:high", "the choice of free axes")
    if (low is not None or high is not None) and f"PhysicsLimitAPI:{token}" not in schemas(prim):
        stage.ledger.assume(prim.GetPath(), f"limits of {token} are authored without PhysicsLimitAPI", "honoured")
    return low, high


def _limited(stage: Stage, prim: Usd.Prim, token: str) -> bool:
    return not all(endless(value, True) for value in _limits(stage, prim, token))


def _own(prim: Usd.Prim, token: str) -> bool:
    """Return whether something is said of one rotation alone."""
    return any(
        prim.GetAuthoredPropertiesInNamespace(f"{space}:{token}") for space in ("drive", "state", "physxJointAxis")
    )


def _at(stage: Stage, prim: Usd.Prim, token: str, value: float) -> Frame:
    """Return the frame of a locked axis that stands at ``value`` in degrees or stage lengths."""
    if value == 0:
        return Frame.identity()
    stage.ledger.assume(prim.GetPath(), f"limits of {token} are equal: locked there", f"{value:g}")
    unit, size = np.array(UNIT[token[-1]]), stage.units.coordinate(value, token in TURNS)
    if token in SLIDES:
        return Frame(np.eye(3), unit * size)
    return Frame(turned(unit, size), np.zeros(3))


def turned(axis: Array, angle: float) -> Array:
    """Return the 3x3 rotation about a unit axis (3,) by an angle in rad (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
