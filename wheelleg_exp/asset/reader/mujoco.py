"""Reads what only MuJoCo's own USD schemas say: actuators on joints, and couplings of joints."""

from __future__ import annotations

import math
from typing import Any

from pxr import Usd

from wheelleg_exp.asset.description import Actuator, Coupling
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.reader.bodies import shown_names
from wheelleg_exp.asset.reader.stage import Stage, schemas

LINEAR = (0.0, 1.0, 0.0, 0.0, 0.0)  # a coupling without coefficients: the same coordinate


def actuators(stage: Stage, joints: dict[str, str]) -> tuple[Actuator, ...]:
    """Return the MjcActuator prims on joints; ``joints`` maps a joint's path to the name of its coordinate."""
    prims = [prim for prim in stage.prims if prim.GetTypeName() == "MjcActuator"]
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    found = (_actuator(stage, prim, names[str(prim.GetPath())], joints) for prim in prims)
    return tuple(actuator for actuator in found if actuator is not None)


def _actuator(stage: Stage, prim: Usd.Prim, name: str, joints: dict[str, str]) -> Actuator | None:
    targets = [str(path) for path in stage.ledger.targets(prim, "mjc:target")]
    gain_type = stage.ledger.read(prim, "mjc:gainType") or "fixed"
    dynamics = stage.ledger.read(prim, "mjc:dynType") or "none"
    if not targets or targets[0] not in joints or (gain_type, dynamics) != ("fixed", "none"):
        stage.ledger.leave(prim.GetPath(), "MjcActuator", "only actuators on joints, without dynamics, are read")
        stage.ledger.warn(f"{prim.GetPath()}: this actuator is not supported and was left out")
        return None
    stage.ledger.mapped(prim.GetPath(), "mjc:target", f"actuator {name}")
    return Actuator(
        name=name,
        path=str(prim.GetPath()),
        joint=joints[targets[0]],
        gain=_numbers(stage, prim, "mjc:gainPrm") or (1.0,),
        bias=_numbers(stage, prim, "mjc:biasPrm"),
        bias_type=stage.ledger.read(prim, "mjc:biasType", "biastype") or "none",
        gear=_numbers(stage, prim, "mjc:gear") or (1.0,),
        control_range=_range(stage, prim, "mjc:ctrlRange"),
        force_range=_range(stage, prim, "mjc:forceRange"),
        inherit_range=float(stage.ledger.read(prim, "mjc:inheritRange", "inheritrange") or 0.0),
    )


def _numbers(stage: Stage, prim: Usd.Prim, name: str) -> tuple[float, ...]:
    """Return an array without the zeros at its end."""
    value: Any = stage.ledger.read(prim, name, "actuator parameters")
    numbers = [] if value is None else [float(v) for v in value]
    while numbers and numbers[-1] == 0.0:
        numbers.pop()
    return tuple(numbers)


def _range(stage: Stage, prim: Usd.Prim, name: str) -> tuple[float, float] | None:
    low = stage.ledger.read(prim, f"{name}:min", "actuator range")
    high = stage.ledger.read(prim, f"{name}:max", "actuator range")
    limited = stage.ledger.read(prim, name.replace("Range", "Limited"), "actuator range") or "auto"
    if limited == "false" or low is None or high is None or not low < high:
        return None
    return (float(low), float(high)) if math.isfinite(low) and math.isfinite(high) else None


def couplings(stage: Stage, joints: dict[str, str]) -> tuple[Coupling, ...]:
    """Return the joints that follow another one, by NewtonMimicAPI and MjcEqualityJointAPI."""
    found = []
    for prim in stage.prims:
        path = str(prim.GetPath())
        if path not in joints or not {"NewtonMimicAPI", "MjcEqualityJointAPI"} & set(schemas(prim)):
            continue
        leader = [str(p) for p in stage.ledger.targets(prim, "newton:mimicJoint", "equality joint")]
        leader += [str(p) for p in stage.ledger.targets(prim, "mjc:target", "equality joint")]
        if not leader or leader[0] not in joints:
            stage.ledger.warn(f"{path}: follows no joint of the robot, so the coupling was left out")
            continue
        name = f"{joints[path]}_coupling"
        found.append(Coupling(name, path, joints[path], joints[leader[0]], _coefficients(stage, prim)))
    return tuple(found)


def _coefficients(stage: Stage, prim: Usd.Prim) -> tuple[float, float, float, float, float]:
    values = list(LINEAR)
    for index in range(5):
        for name in (f"newton:mimicCoef{index}", f"mjc:coef{index}"):
            value = stage.ledger.read(prim, name, "equality joint polycoef")
            if value is not None:
                values[index] = float(value)
    a, b, c, d, e = values
    return a, b, c, d, e
