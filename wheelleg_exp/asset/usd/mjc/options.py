"""Reads MuJoCo's scene: options, flags, and compiler settings with what they do to masses and inertias."""

from __future__ import annotations

from dataclasses import replace

from pxr import Usd

from wheelleg_exp.asset.description import Inertial, RobotDescription, Vec3
from wheelleg_exp.asset.usd.mjc.angles import find_scene
from wheelleg_exp.asset.usd.mjc.values import Attribute, attributes, indices, leave
from wheelleg_exp.asset.usd.stage import Stage

INTEGRATORS = {"euler": "Euler", "rk4": "RK4", "implicit": "implicit", "implicitfast": "implicitfast"}
OPTIONS = {  # what changes the model; steps and solvers belong to the task
    f"mjc:option:{name}": name
    for name in (
        "cone",
        "impratio",
        "density",
        "viscosity",
        "wind",
        "magnetic",
        "o_margin",
        "o_solref",
        "o_solimp",
        "o_friction",
        "noslip_iterations",
        "noslip_tolerance",
    )
}
GROUPS = 31  # groups of actuators that MuJoCo can switch off
FLAGS = (
    "constraint",
    "equality",
    "frictionloss",
    "limit",
    "contact",
    "spring",
    "damper",
    "gravity",
    "clampctrl",
    "warmstart",
    "filterparent",
    "actuation",
    "refsafe",
    "sensor",
    "midphase",
    "eulerdamp",
    "autoreset",
    "nativeccd",
    "island",
    "override",
    "energy",
    "fwdinv",
    "invdiscrete",
    "multiccd",
    "sleep",
)
SOLVER = "a setting of the solver or the step, which the task owns, not the robot"
SOLVER_OPTIONS = (
    "apirate",
    "timestep",
    "iterations",
    "ls_iterations",
    "tolerance",
    "ls_tolerance",
    "ccd_iterations",
    "ccd_tolerance",
    "sdf_iterations",
    "sdf_initpoints",
    "sleep_tolerance",
    "jacobian",
    "solver",
)
COMPILER = {  # why these settings are not written
    "angle": "angles are written in radians",
    "autoLimits": "ranges are written with what they mean",
    "saveInertial": "a setting for saving models",
    "useThread": "a setting of the compiler's speed",
    "fitAABB": "shapes are written as they are",
    "inertiaFromGeom": "masses and inertias are written explicitly",
    "inertiaGroupRange:min": "masses and inertias are written explicitly",
    "inertiaGroupRange:max": "masses and inertias are written explicitly",
    "balanceInertia": "inertias that no solid has are made possible in any file",
    "fuseStatic": "bodies are kept as the file has them",
    "alignFree": "a setting of the compiler's speed",
}


def with_options(stage: Stage, robot: RobotDescription) -> RobotDescription:
    """Return the robot with the scene's options and flags, and its masses as the scene's compiler leaves them."""
    scene = find_scene(stage)
    if scene is None:
        return robot
    for name in SOLVER_OPTIONS:
        leave(stage, scene, f"mjc:option:{name}", SOLVER)
    for name, reason in COMPILER.items():
        leave(stage, scene, f"mjc:compiler:{name}", reason)
    robot = with_compiled_masses(stage, scene, robot)
    flags = {**robot.flag, **_flags(stage, scene)}
    return replace(robot, option={**robot.option, **_options(stage, scene)}, flag=flags)


def _options(stage: Stage, scene: Usd.Prim) -> dict[str, Attribute]:
    found: dict[str, Attribute] = {}
    name = "mjc:option:integrator"
    integrator = stage.ledger.read(scene, name, "option integrator")
    if integrator in INTEGRATORS:
        found["integrator"] = INTEGRATORS[integrator]
    elif integrator is not None:
        stage.ledger.leave(scene.GetPath(), name, "not an integrator of MuJoCo", integrator)
    found |= attributes(stage, scene, OPTIONS)
    off = [g for g in indices(stage, scene, "mjc:option:actuatorgroupdisable", "option") if 0 <= g < GROUPS]
    if off:
        found["actuatorgroupdisable"] = " ".join(map(str, off))
    return found


def _flags(stage: Stage, scene: Usd.Prim) -> dict[str, Attribute]:
    found = attributes(stage, scene, {f"mjc:flag:{name}": name for name in FLAGS})
    passive = stage.ledger.read(scene, "mjc:flag:passive", "flags spring and damper")  # of older files
    if passive is not None:
        found = {"spring": passive, "damper": passive, **found}
    return {name: "enable" if on else "disable" for name, on in found.items()}


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
