"""Rules about the robot's file: what it lacks, what the conversion lost, and numbers that no link or motor has."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import mujoco
import numpy as np

from wheelleg_exp.anatomy.collider_shapes import reach
from wheelleg_exp.anatomy.compiled_robot import LOST_MESH, CompiledRobot, missing_colliders
from wheelleg_exp.anatomy.limbs import TURNS
from wheelleg_exp.asset.conversion_report import UNITS, Kind, size_problem
from wheelleg_exp.asset.conversion_report import Finding as Record
from wheelleg_exp.lint.rule import Case, Finding, listed, rule

_ASSET = "env.robot.asset"
_ASSUMED = 0.05  # Links without a mass in the robot file may have at most 5 % of the robot's mass.
_WEIGHTY = 0.01  # The lint rules ignore the inertia of a link with less than 1 % of the robot's mass.
_LOST = re.compile(r"(collider|coupling|attribute .*) was left out|wrong way round|drive is lost|not degrees")
_MOST = 4


def records(case: Case, kind: Kind) -> list[Record]:
    """Return the findings of one kind, such as ``impossible_inertia``, in the robot's conversion report."""
    report = case.robot.report if case.robot is not None else None
    return [item for item in report.findings if item.kind == kind] if report is not None else []


@rule
def missing_files(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """Mesh files of the robot's colliders, or USD layers of the robot file, are missing or damaged.

    The mesh file of a collider can be missing, damaged, or a Git LFS pointer. If the collider of a wheel is missing,
    the wheel's joint counts as a leg joint. Missing meshes of visuals are ignored. Source: the conversion report.
    """
    report = robot.report
    if report is None:
        return
    message = missing_colliders(report, robot.model)
    layers = [item.subject for item in records(case, "layer_not_found") if not item.numbers["looks"]]
    if message or layers:
        message = message or f"layers that the robot names are missing: {', '.join(layers[:_MOST])}"
        yield Finding(_ASSET, message, "put the files at the named paths (git lfs pull), or correct the names")


@rule
def no_colliders(_case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """The robot has no colliders.

    A robot without colliders falls through the ground. Source: the compiled model.
    """
    bodies = {robot.model.body(name).id for name in robot.bodies}
    solid = (robot.model.geom_contype != 0) | (robot.model.geom_conaffinity != 0)
    if not any(int(body) in bodies for body in robot.model.geom_bodyid[solid]):
        hint = "colliders: a cylinder on each wheel and a box on the body are enough to start with"
        yield Finding(_ASSET, "no shape of the robot collides: it falls through the ground", hint)


@rule
def assumed_masses(case: Case) -> Iterator[Finding]:
    """The robot file lacks masses or inertias, so the converter assumed values for them.

    An assumed mass, a volume times a density or 1 kg, makes the dynamics inaccurate. Source: the conversion report.
    """
    total = case.facts.mass
    links = [item for item in records(case, "no_inertial") if item.numbers["mass"] > 0]
    assumed = sum(item.numbers["mass"] for item in links)
    if assumed > _ASSUMED * total:
        message = f"{assumed:.3g} of {total:.4g} kg are assumed ({100 * assumed / total:.0f} %): {len(links)} "
        message += f"{'link has' if len(links) == 1 else 'links have'} no mass, such as '{links[0].subject}'"
        hint = "mass and inertia of these links in the file"
        yield Finding(_ASSET, message, hint, {"assumed_kg": assumed, "mass_kg": total})
    guessed = [item for item in records(case, "no_inertia") if item.numbers["mass"] > _WEIGHTY * total]
    if guessed:
        how = "computed from the shapes" if guessed[0].numbers.get("computed") else "assumed"
        message = f"{len(guessed)} {'link has' if len(guessed) == 1 else 'links have'} a mass and no inertia, such as "
        message += f"'{guessed[0].subject}': the tensor is {how}"
        yield Finding(_ASSET, message, "inertia of these links in the file", {"links": float(len(guessed))})


@rule
def lost_in_conversion(_case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """The conversion to MuJoCo lost or changed colliders, limits, couplings, attributes, or drives of the robot file.

    Angles that are probably degrees are reported, too. Source: the warnings of the conversion report.
    """
    report = robot.report
    lost = [text for text in report.warnings if _LOST.search(text) and not LOST_MESH.search(text)] if report else []
    if lost:
        shown = "; ".join(lost[:_MOST]) + (f"; and {len(lost) - _MOST} more" if len(lost) > _MOST else "")
        hint = "correct the file: `wheelleg convert` shows all warnings"
        yield Finding(_ASSET, shown, hint, {"lost": float(len(lost))})


_LIGHT = 2.0  # A robot's mass (kg) divided by the cube of its length (m³) is at least 2 for any plausible robot.
_WIDE = 1.5  # A link's radius of gyration above 1.5 times the link's extent is implausible.
_NARROW = 0.03  # A link's radius of gyration below 3 % of the link's extent is implausible.
_OUTSIDE = 0.5  # A link's centre of mass may be outside of the link's shapes by at most 50 % of the link's extent.
_TRIANGLE = 0.01  # One moment of inertia of a link may exceed the sum of the other two by at most 1 %.
_LOCKED = 0.02  # A joint with a range below 0.02 rad counts as locked.
_PLACEHOLDER = 50.0  # An effort limit above 50 times the robot's weight times the robot's length is implausible.
_FAST = 200.0  # A joint speed limit above 200 rad/s is implausible.


@rule
def robot_size(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """The robot's mass is implausible for its size, or its root link is below the ground.

    The usual cause is a wrong unit in the robot file. Source: the density of a cube whose edge is the robot's longest.
    """
    problem = size_problem(case.facts.mass, robot.anatomy.size, _LIGHT)
    if problem:
        yield Finding(_ASSET, problem, UNITS, {"mass_kg": case.facts.mass, "size_m": robot.anatomy.size})
    if case.facts.standing_height < 0:
        message = f"the root link '{robot.anatomy.base}' is {-1e3 * case.facts.standing_height:.4g} mm below the ground"
        yield Finding(_ASSET, message, "a root link inside the robot's body")


@rule
def link_masses(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """A link's mass or inertia does not fit the link's size.

    A real link's radius of gyration sqrt(I / m) is 1/30 to 1 of its extent, measured from the centre of mass, which is
    inside or near its shapes. No principal moment exceeds the sum of the other two. Source: mechanics of rigid bodies.
    """
    mass = case.facts.mass
    if size_problem(mass, robot.anatomy.size, _LIGHT):
        return
    written = records(case, "impossible_inertia")
    impossible = [_untrue(item.subject, *(item.numbers[name] for name in "abc")) for item in written]
    findings = [finding for name in robot.bodies for finding in _link(robot, name, mass)]
    yield from [*impossible, *findings][:_MOST]


def _untrue(name: str, a: float, b: float, c: float) -> Finding:
    message = f"'{name}' has the moments of inertia {a:.3g}, {b:.3g}, {c:.3g} kg·m²: one is more than the sum of the "
    message += "other two, which is impossible"
    return Finding(_ASSET, message, "the tensor from CAD, about the centre of mass")


def _link(robot: CompiledRobot, name: str, whole: float) -> Iterator[Finding]:
    model, body = robot.model, robot.model.body(name).id
    mass, moments = float(model.body_mass[body]), np.sort(model.body_inertia[body])
    if mass < _WEIGHTY * whole:
        return
    if moments[2] > (1 + _TRIANGLE) * (moments[0] + moments[1]):
        yield _untrue(name, *moments.tolist())
    geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
    if not geoms:
        return
    centre, frame = robot.data.xipos[body], robot.data.xmat[body].reshape(3, 3)
    out = reach(model, robot.data, geoms, centre, np.vstack([frame.T, -frame.T]))
    extent = float(np.linalg.norm(np.maximum(out[:3], out[3:])))
    radius = math.sqrt(float(moments[2]) / mass)
    if radius > _WIDE * extent or radius < _NARROW * extent:
        word = "more" if radius > extent else "less"
        yield Finding(
            _ASSET,
            f"'{name}' of {mass:.3g} kg has a moment of inertia of {moments[2]:.3g} kg·m², as if its mass were "
            f"{1e3 * radius:.3g} mm from its centre: {word} than a link that reaches {1e3 * extent:.3g} mm can have",
            f"the tensor from CAD, in kg·m²; a solid of this size has about {mass * extent**2 / 5:.2g}",
            {"gyration_m": radius, "reach_m": extent},
        )
    beyond = -float(out.min())
    if beyond > _OUTSIDE * extent:
        message = f"the centre of mass of '{name}' lies {1e3 * beyond:.3g} mm outside its shapes"
        hint = "the origin of its inertia in the file: metres, in the link's frame"
        yield Finding(_ASSET, message, hint, {"outside_m": beyond})


@rule
def joint_limits(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """A driven leg joint has no limits, or its limits allow no motion.

    A leg without joint limits can pass through the robot, and rewards for soft joint limits have no effect. Source: the
    parameter ``soft_joint_pos_limit_factor`` of Isaac Lab 2.3.2, and joint/range in MuJoCo's XML reference.
    """
    legs = [name for leg in robot.anatomy.legs for name in leg.joints if name not in leg.passive]
    free, locked = [], []
    for name in [*dict.fromkeys(legs), *robot.anatomy.others]:
        joint = robot.model.joint(name).id
        if robot.model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        low, high = robot.model.jnt_range[joint]
        if robot.model.jnt_limited[joint] and high - low < _LOCKED:
            locked.append(name)
        elif name in legs and (not robot.model.jnt_limited[joint] or high - low > TURNS):
            free.append(name)
    steered = {name for w in robot.anatomy.wheels if w.steered for g in robot.anatomy.legs for name in g.joints
               if g.wheel == w.joint}  # fmt: skip
    free = [name for name in free if name not in steered | robot.anatomy.casters]
    if free:
        found = [*records(case, "limits_ignored"), *records(case, "no_limits")]
        written = [item.numbers for item in found if item.subject in free and "lower" in item.numbers]
        says = f" (the file writes {written[0]['lower']:g} to {written[0]['upper']:g})" if written else ""
        message = f"{listed(free)} {'has' if len(free) == 1 else 'have'} no limits{says}: a leg may turn all round"
        hint = 'the limits of the real joint (URDF: type="revolute" with lower and upper; USD: physics:lowerLimit)'
        yield Finding(_ASSET, message, hint, {"joints": float(len(free))})
    if locked:
        hint = "the limits of the real joint, or a fixed joint; exporters write 0 to 0 if CAD has no limits"
        yield Finding(_ASSET, f"the limits of {listed(locked)} allow no motion", hint, {"joints": float(len(locked))})


@rule
def placeholder_limits(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """Limits of effort and speed that no motor has: 0, or so large that they have no effect.

    An effort limit is not realistic if the torque could lift fifty times the robot's weight on an arm as long as the
    robot. Policies that are trained with it do not work on the real robot. Source: statics.
    """
    facts = case.facts
    most = _PLACEHOLDER * facts.weight * robot.anatomy.size
    strong, fast = [], []
    # A task config sets its own effort and velocity limits, so ignore limits of 0 in the robot file.
    kinds: tuple[Kind, ...] = ("placeholder_effort", "placeholder_velocity")
    written = {item.subject for kind in kinds for item in records(case, kind) if abs(item.numbers["value"]) < 1}
    weak = [name for name in facts.joints if name in written - robot.anatomy.casters and not case.of_task]
    for name, joint in facts.joints.items():
        if joint.drive is None:
            continue
        if most < joint.drive.effort < math.inf:
            strong.append(name)
        if _FAST < joint.drive.velocity < math.inf:
            fast.append(name)
    for names, what, hint in (
        (weak, "an effort or velocity limit of 0 in the file, as exporters write if CAD has no limits",
         "the motors' largest torque and speed"),
        (strong, f"effort limits beyond {most:.3g} N·m, which lift fifty times the robot on an arm of its own size",
         "the motors' largest torque"),
        (fast, f"velocity limits above {_FAST:g} rad/s", "the motors' largest speed in rad/s (not °/s)"),
    ):  # fmt: skip
        if names:
            drive = facts.joints[names[0]].drive
            key = f"env.robot.actuators.{drive.group}" if drive is not None else "env.robot.actuators"
            yield Finding(key, f"{listed(names)} {'has' if len(names) == 1 else 'have'} {what}", hint)
