"""Does to masses and inertias what the scene's compiler would: bounds and a total.

Order and meaning: https://mujoco.readthedocs.io/en/stable/XMLreference.html#compiler
"""

from __future__ import annotations

from dataclasses import replace

from pxr import Usd

from wheelleg_exp.asset.description import Inertial, RobotDescription, Vec3
from wheelleg_exp.asset.reader.stage import Stage

NAMES = ("boundMass", "boundInertia", "setTotalMass")


def with_compiled_masses(stage: Stage, scene: Usd.Prim, robot: RobotDescription) -> RobotDescription:
    """Return the robot with the masses that the scene's compiler settings make of its own."""
    values = {
        name: stage.ledger.read(scene, f"mjc:compiler:{name}", "masses and inertias of the bodies") for name in NAMES
    }
    if not any(values.values()):
        return robot
    bodies = robot.bodies
    least, smallest = values["boundMass"] or 0.0, values["boundInertia"] or 0.0
    inertials = [_bounded(body.inertial, least, smallest) for body in bodies]
    total, wanted = sum(inertial.mass for inertial in inertials), values["setTotalMass"] or 0.0
    if wanted > 0 and total > 0:
        stage.ledger.assume(scene.GetPath(), "mjc:compiler:setTotalMass scales all masses", f"{wanted / total:.6g}")
        inertials = [_scaled(inertial, wanted / total) for inertial in inertials]
    return replace(
        robot, bodies=tuple(replace(b, inertial=inertial) for b, inertial in zip(bodies, inertials, strict=True))
    )


def _bounded(inertial: Inertial, least: float, smallest: float) -> Inertial:
    a, b, c = (max(moment, smallest) for moment in inertial.moments)
    return replace(inertial, mass=max(inertial.mass, least), moments=(a, b, c))


def _scaled(inertial: Inertial, factor: float) -> Inertial:
    a, b, c = inertial.moments
    moments: Vec3 = (a * factor, b * factor, c * factor)
    return replace(inertial, mass=inertial.mass * factor, moments=moments)
