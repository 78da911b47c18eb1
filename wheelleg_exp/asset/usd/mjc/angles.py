"""Finds MuJoCo's scene, which says in which unit its schemas hold angles."""

from __future__ import annotations

import math
from collections.abc import Iterable

from pxr import Usd, UsdPhysics

from wheelleg_exp.asset.usd.stage import Stage, schemas


def find_scene(stage: Stage) -> Usd.Prim | None:
    """Return MuJoCo's scene, wherever it is: the first PhysicsScene with MjcSceneAPI."""
    top = stage.usd.GetPseudoRoot()
    near: Iterable[Usd.Prim] = top.GetChildren()
    for prims in (near, Usd.PrimRange(top)):
        for prim in prims:
            if prim.IsA(UsdPhysics.Scene) and "MjcSceneAPI" in schemas(prim):
                return prim
    return None


def angle_in_radians(stage: Stage, value: float) -> float:
    """Return an angle that MuJoCo's schemas hold in the unit of the scene's compiler: degrees unless it says radian."""
    scene = find_scene(stage)
    unit = stage.ledger.read(scene, "mjc:compiler:angle", "the unit of mjc:ref and mjc:springref") if scene else None
    return value if unit == "radian" else math.radians(value)
