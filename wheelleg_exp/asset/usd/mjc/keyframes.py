"""Reads MjcKeyframe prims, whose arrays are in the order of MuJoCo's own model."""

from __future__ import annotations

from pxr import Usd

from wheelleg_exp.asset.description import Actuator, Keyframe, RobotDescription
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.usd.bodies.rigid_bodies import shown_names
from wheelleg_exp.asset.usd.mjc.values import attributes
from wheelleg_exp.asset.usd.stage import Stage

KIND = "MjcKeyframe"
NAMES = {f"mjc:{name}": name for name in ("qpos", "qvel", "act", "ctrl", "mpos", "mquat")}


def read_keyframes(stage: Stage, robot: RobotDescription) -> tuple[Keyframe, ...]:
    """Return the keyframes that fit the robot's number of coordinates, velocities and controls."""
    prims = [prim for prim in stage.prims if prim.GetTypeName() == KIND]
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    found = (_keyframe(stage, prim, names[str(prim.GetPath())], robot) for prim in prims)
    return tuple(keyframe for keyframe in found if keyframe is not None)


def _keyframe(stage: Stage, prim: Usd.Prim, name: str, robot: RobotDescription) -> Keyframe | None:
    extra = attributes(stage, prim, NAMES)
    for key, count in sizes(robot).items():
        value = extra.get(key)
        if isinstance(value, tuple) and len(value) != count:
            reason = f"its {key} has {len(value)} numbers, the model {count}"
            stage.ledger.leave(prim.GetPath(), KIND, reason)
            stage.ledger.warn(f"{prim.GetPath()}: this keyframe was left out: {reason}")
            return None
    stage.ledger.mapped(prim.GetPath(), KIND, f"keyframe {name}")
    return Keyframe(name, str(prim.GetPath()), extra)


def sizes(robot: RobotDescription) -> dict[str, int]:
    """Return how many numbers each array of a keyframe has."""
    free = sum(body.floating for body in robot.bodies)
    balls = sum(dof.kind == "ball" for dof in robot.dofs)
    single = len(robot.dofs) - balls
    mocap = sum(body.mocap for body in robot.bodies)
    controls = len(robot.actuators) + sum(dof.drive is not None for dof in robot.dofs)
    return {
        "qpos": 7 * free + 4 * balls + single,
        "qvel": 6 * free + 3 * balls + single,
        "ctrl": controls,
        "act": sum(_states(actuator) for actuator in robot.actuators),
        "mpos": 3 * mocap,
        "mquat": 4 * mocap,
    }


def _states(actuator: Actuator) -> int:
    """Return how many states an actuator's dynamics have."""
    own = actuator.extra.get("actdim", -1)
    if isinstance(own, int) and own >= 0:
        return own
    return 0 if actuator.extra.get("dyntype", "none") == "none" else 1
