"""Puts together what is known of one degree of freedom."""

from __future__ import annotations

from dataclasses import asdict

from pxr import Usd

from wheelleg_exp.asset.description import Dof, Vec3
from wheelleg_exp.asset.reader.axes import FreeAxis
from wheelleg_exp.asset.reader.drives import clamped, read_drive
from wheelleg_exp.asset.reader.limits import read_range
from wheelleg_exp.asset.reader.mujoco.angles import angle_in_radians
from wheelleg_exp.asset.reader.passive import force_range, read_passive, velocity_limit
from wheelleg_exp.asset.reader.stage import Stage


def read_dof(stage: Stage, prim: Usd.Prim, axis: FreeAxis, name: str, direction: Vec3, anchor: Vec3) -> Dof:
    """Return one degree of freedom, ``direction`` and ``anchor`` (m) in the frame of the body below it."""
    angular = axis.kind != "slide"
    limits, ref = read_range(stage, prim, axis), _ref(stage, prim, angular)
    state, speed = _state(stage, prim, axis)
    stage.ledger.mapped(prim.GetPath(), str(prim.GetTypeName()), f"joint {name} ({axis.kind})")
    return Dof(
        name=name,
        path=str(prim.GetPath()),
        kind=axis.kind,
        axis=direction,
        anchor=anchor,
        range=limits,
        max_velocity=velocity_limit(stage, prim, axis),
        force_range=force_range(stage, prim, angular),
        drive=None if axis.kind == "ball" else read_drive(stage, prim, axis, limits, ref),
        position=ref if state is None else clamped(stage, prim, "the saved state", state + ref, limits),
        velocity=speed,
        ref=ref,
        extra={},
        **asdict(read_passive(stage, prim, axis)),
    )


def _ref(stage: Stage, prim: Usd.Prim, angular: bool) -> float:
    """Return MuJoCo's coordinate where USD's is zero, in rad or m."""
    value = stage.ledger.read(prim, "mjc:ref", "joint ref")
    if value is None:
        return 0.0
    return angle_in_radians(stage, float(value)) if angular else float(value) * stage.units.meters


def _state(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> tuple[float | None, float]:
    """Return the saved coordinate, None when there is none, and the saved speed."""
    read, units, angular = stage.ledger.read, stage.units, axis.kind != "slide"
    position = read(prim, f"state:{axis.token}:physics:position", "keyframe home, qpos")
    velocity = read(prim, f"state:{axis.token}:physics:velocity", "keyframe home, qvel")
    return None if position is None else units.coordinate(position, angular), units.coordinate(velocity or 0.0, angular)
