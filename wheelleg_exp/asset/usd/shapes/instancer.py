"""Where a PointInstancer puts its prototypes."""

from __future__ import annotations

from collections.abc import Iterator, Sized
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from wheelleg_exp.asset.geometry import Array
from wheelleg_exp.asset.sources import FARTHEST, MOST_SHAPES
from wheelleg_exp.asset.usd.stage import Stage, schemas


@dataclass(frozen=True, eq=False)
class Placed:
    """A gprim of a prototype as one instance shows it: its map (4x4) to the world in metres, and the instance."""

    prim: Usd.Prim
    carrier: Usd.Prim | None
    matrix: Array
    index: int


def placed_gprims(stage: Stage, instancer: Usd.Prim) -> Iterator[Placed]:
    """Yield the gprims of all instances; what cannot be expanded is reported."""
    api, time = UsdGeom.PointInstancer(instancer), Usd.TimeCode.Default()
    roots = [stage.usd.GetPrimAtPath(path) for path in api.GetPrototypesRel().GetForwardedTargets()]
    if not roots or not all(roots):
        return _refuse(stage, instancer, "its prototypes are not there")
    shapes = [_gprims(root) for root in roots]
    if any("PhysicsRigidBodyAPI" in schemas(prim) for root in roots for prim in Usd.PrimRange(root)):
        return _refuse(stage, instancer, "its prototypes are rigid bodies, of which it makes many")
    if any(len(values) > MOST_SHAPES for values in _arrays(instancer)):
        return _refuse(stage, instancer, f"it makes more than {MOST_SHAPES:,} instances")
    indices, maps = _instances(api, time)
    if indices is None or len(indices) != len(maps) or any(not 0 <= i < len(roots) for i in indices):
        return _refuse(stage, instancer, "its protoIndices do not fit its positions and prototypes")
    if sum(len(shapes[i]) for i in indices) > MOST_SHAPES:
        return _refuse(stage, instancer, f"it makes more than {MOST_SHAPES:,} shapes")
    if not all((np.abs(matrix) <= FARTHEST).all() for matrix in maps):
        return _refuse(stage, instancer, f"its transforms are not finite, or reach more than {FARTHEST:g} m")
    stage.ledger.mapped(instancer.GetPath(), "PointInstancer", f"the shapes of {len(indices)} instances")
    above = stage.matrix(instancer)
    inside = UsdGeom.XformCache(time)
    for number, (which, local) in enumerate(zip(indices, maps, strict=True)):
        for gprim, carrier in shapes[which]:
            within = np.array(inside.ComputeRelativeTransform(gprim, roots[which])[0], dtype=float).T
            yield Placed(gprim, carrier, above @ local @ within, number)


def _refuse(stage: Stage, instancer: Usd.Prim, reason: str) -> None:
    stage.ledger.leave(instancer.GetPath(), "PointInstancer", reason)
    stage.ledger.warn(f"{instancer.GetPath()}: a PointInstancer was left out: {reason}")


def _gprims(root: Usd.Prim) -> list[tuple[Usd.Prim, Usd.Prim | None]]:
    """Return a prototype's gprims, each with the prim that makes it collide."""
    found = []
    carriers: dict[object, Usd.Prim] = {}
    for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies()):
        carrier = prim if "PhysicsCollisionAPI" in schemas(prim) else carriers.get(prim.GetPath().GetParentPath())
        if prim.IsA(UsdGeom.Gprim):
            found.append((prim, carrier))
        elif carrier is not None:
            carriers[prim.GetPath()] = carrier
    return found


def _arrays(instancer: Usd.Prim) -> Iterator[Sized]:
    names = ("protoIndices", "positions", "orientations", "orientationsf", "scales", "invisibleIds", "ids")
    values = (instancer.GetAttribute(name).Get() for name in names if instancer.HasAttribute(name))
    yield from (value for value in values if isinstance(value, Sized))


def _instances(api: UsdGeom.PointInstancer, time: Usd.TimeCode) -> tuple[list[int] | None, list[Array]]:
    """Return which prototype each instance shows, and its map to the instancer; masked ones are left away."""
    which = api.GetProtoIndicesAttr().Get(time)
    if which is None or np.asarray(which).dtype.kind not in "iu":
        return None, []
    transforms = api.ComputeInstanceTransformsAtTime(time, time)
    mask = list(api.ComputeMaskAtTime(time))
    shown = [int(i) for number, i in enumerate(which) if number >= len(mask) or mask[number]]
    return shown, [np.array(matrix, dtype=float).T for matrix in transforms]
