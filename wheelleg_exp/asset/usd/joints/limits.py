"""Reads the range of a free axis."""

from __future__ import annotations

from pxr import Usd

from wheelleg_exp.asset.usd.joints.axes import FreeAxis
from wheelleg_exp.asset.usd.stage import Stage
from wheelleg_exp.asset.usd.units import Units, endless

Range = tuple[float, float]
FAR = 1e6  # stands for the missing side of a range
LOCKED = 1e-4  # rad or m: half a range that is as good as none, because MuJoCo's has to have a width


def read_range(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> Range | None:
    """Return the limits of one axis in rad or m, None when it has none."""
    if axis.kind == "ball":
        return _cone(stage, prim)
    if axis.token == "twist":
        return None
    if axis.suffix:
        return _generic(stage, prim, axis)
    return _single(stage, prim, axis.kind == "hinge")


def _generic(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> Range | None:
    low = stage.ledger.read(prim, f"limit:{axis.token}:physics:low", "range")
    high = stage.ledger.read(prim, f"limit:{axis.token}:physics:high", "range")
    return _range(stage.units, low, high, axis.kind == "hinge", one_sided=True)


def _single(stage: Stage, prim: Usd.Prim, angular: bool) -> Range | None:
    ledger = stage.ledger
    low = ledger.read(prim, "physics:lowerLimit", "range")
    high = ledger.read(prim, "physics:upperLimit", "range")
    if low is not None and high is not None and low == high:
        ledger.assume(prim.GetPath(), "lower and upper limit are equal: no limits", f"{low:g}")
        ledger.find("no_limits", prim.GetName(), prim.GetPath(), lower=low, upper=high)
        ledger.warn(f"{prim.GetPath()}: limits {low:g} to {high:g} are read as none; PhysX locks such a joint")
        return None
    if low is not None and high is not None and low > high:
        ledger.assume(prim.GetPath(), "the lower limit is above the upper one: locked, as PhysX", LOCKED)
        ledger.find("no_limits", prim.GetName(), prim.GetPath(), lower=low, upper=high)
        ledger.warn(f"{prim.GetPath()}: limits {low:g} to {high:g} are the wrong way round; the joint is locked at 0")
        return -LOCKED, LOCKED
    found = _range(stage.units, low, high, angular, one_sided=not angular)
    if found is None and (low is not None or high is not None):
        ledger.assume(prim.GetPath(), "limits are infinite, huge or one-sided: none", f"{low} to {high}")
    return found


def _range(units: Units, low: float | None, high: float | None, angular: bool, one_sided: bool) -> Range | None:
    """Return a range in rad or m; where ``one_sided`` is off, a missing side means no limits at all."""
    no_low, no_high = endless(low, angular), endless(high, angular)
    if (no_low and no_high) or ((no_low or no_high) and not one_sided):
        return None
    return (
        -FAR if no_low or low is None else units.coordinate(low, angular),
        FAR if no_high or high is None else units.coordinate(high, angular),
    )


def _cone(stage: Stage, prim: Usd.Prim) -> Range | None:
    """Return a ball's range: the smaller angle of the cone. Angles below 0 are no limits."""
    ledger, path = stage.ledger, prim.GetPath()
    angles = [ledger.read(prim, f"physics:coneAngle{i}Limit", "range of the ball") for i in (0, 1)]
    given = [a for a in angles if a is not None and 0 <= a < 360]
    if not given:
        return None
    if len(set(given)) > 1:
        ledger.warn(f"{path}: cone angles {given} differ, the smaller one limits all directions")
    positive = [a for a in given if a > 0]
    if not positive:
        ledger.warn(f"{path}: a cone angle of 0 has no place in a ball's range; the ball is not limited")
        return None
    ledger.assume(path, "a ball's range limits turning about the cone's axis too", f"{min(positive):g} degrees")
    return 0.0, stage.units.coordinate(min(positive), True)
