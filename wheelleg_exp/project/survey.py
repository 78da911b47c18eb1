"""Measure a robot for a new project: the role of each joint, the drives, and a pose in which the robot stands."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.anatomy.anatomy_parts import Anatomy
from wheelleg_exp.anatomy.collider_shapes import lowest_point, overlap_depths
from wheelleg_exp.anatomy.compiled_robot import (
    Drive,
    RobotFacts,
    at_default,
    measure,
    missing_colliders,
    name_expression,
    provisional_robot,
    with_written_limits,
)
from wheelleg_exp.anatomy.robot_anatomy import anatomy_of
from wheelleg_exp.anatomy.stance import Stance, solve_stance
from wheelleg_exp.asset import Conversion, RobotDescription, convert
from wheelleg_exp.asset.conversion_report import size_problem
from wheelleg_exp.asset.robot_description import Dof
from wheelleg_exp.errors import AssetError, ConfigError, named_as
from wheelleg_exp.managers.scene_manager import SceneManager
from wheelleg_exp.rl.mirror_pairs import joint_images, joint_signs
from wheelleg_exp.sim.names import values_by_name
from wheelleg_exp.sim.robot import Robot

_INSIDE = 0.25  # A default joint position beyond a limit moves to 25 % of the joint's range inside the limit.
_OFF = 0.02  # A default joint position stays at least 2 % of the joint's range away from both limits.
Quaternion = tuple[float, float, float, float]
Array = NDArray[np.float64]

_ALONG = math.cos(math.radians(15))  # Two axes count as parallel if the angle between them is below 15 degrees.
_LEAN = math.radians(0.5)  # Smaller leans are ignored.


@dataclass(frozen=True)
class Standing:
    """How a robot stands.

    ``frame`` (w, x, y, z) rotates the root link's frame so that x points forwards and z upwards; None if they already
    do. ``rotation`` (w, x, y, z) is that of the root link in the world. ``positions`` maps leg joints to positions, rad
    or m. ``stance`` is None without wheels. ``lean`` is the pitch of the base, rad, positive if the front is lower.
    """

    frame: Quaternion | None
    rotation: Quaternion
    positions: dict[str, float]
    stance: Stance | None
    lean: float


def stand(model: mujoco.MjModel, anatomy: Anatomy, qpos: Array) -> Standing:
    """Compute a pose in which the robot stands, near the pose ``qpos`` (nq,)."""
    stance = solve_stance(model, anatomy, qpos)
    lean = stance.lean if stance is not None and not stance.balanced and abs(stance.lean) > _LEAN else 0.0
    frame = _frame(anatomy, lean)
    w, x, y, z = (float(part) for part in qpos[3:7]) if frame is None else (1.0, 0.0, 0.0, 0.0)
    return Standing(frame, (w, x, y, z), {} if stance is None else stance.positions, stance, lean)


def _frame(anatomy: Anatomy, lean: float) -> Quaternion | None:
    """Return the rotation from the robot file's root frame to a frame with x forwards and z up, pitched by ``lean``.

    If forward, left, and up are within 15 degrees of the robot file's coordinate axes, these axes are used instead.
    """
    if anatomy.forward is None or anatomy.left is None:
        return None
    axes = np.array([anatomy.forward, anatomy.left, anatomy.up])
    near = np.rint(axes)
    if np.all((axes * near).sum(axis=1) >= _ALONG) and abs(np.linalg.det(near) - 1.0) < 1e-9:
        axes = near
    forward, left, up = axes
    cos, sin = math.cos(lean), math.sin(lean)
    axes = np.array([cos * forward + sin * up, left, cos * up - sin * forward])
    if np.allclose(axes, np.eye(3)):
        return None
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, axes.T.ravel().copy())
    w, x, y, z = (round(float(part), 6) + 0.0 for part in quat)
    return w, x, y, z


_GROUND = 0.05  # A body below 5 % of the robot's standing height counts as touching the ground.
_LEVEL = 0.99  # The root link is upright if the cosine of its tilt is at least 0.99.
_EXPECTED = "a robot with joints to drive and colliders to stand on"


@dataclass(frozen=True)
class Survey:
    """A robot and its dimensions in its default pose.

    ``dofs`` maps joint names to degrees of freedom, breadth first. ``legs`` contains the driven joints between base and
    wheels, or without wheels all driven joints; ``held``, driven joints that no action moves, such as those of an arm.
    ``passive`` joints have no drive. ``positions`` is the default pose, rad or m; ``standing`` is the computed pose, or
    None if the caller gave positions. ``overlaps`` maps pairs of links to the depth, m, by which they overlap. ``size``
    is the height of the root link or of the centre of mass, m, whichever is larger. ``up`` is the axis of the root link
    that points upwards. ``trunk`` is the heaviest link that is fixed to the root link; ``trunk_mass`` is in kg.
    ``wheel_bodies`` touch the ground; ``raised_bodies`` have colliders, but do not. ``asymmetry`` is the reason why the
    policy of a robot cannot learn from mirror images; None for a symmetric robot. ``notes`` are warnings.
    """

    dofs: dict[str, Dof]
    legs: list[str]
    held: list[str]
    wheels: list[str]
    passive: list[str]
    positions: dict[str, float]
    rotation: Quaternion
    standing: Standing | None
    overlaps: dict[tuple[str, str], float]
    facts: RobotFacts
    anatomy: Anatomy
    size: float
    up: tuple[float, float, float]
    trunk: str
    trunk_mass: float
    wheel_bodies: list[str]
    raised_bodies: list[str]
    asymmetry: str | None
    notes: list[str]

    @property
    def level(self) -> bool:
        """Whether the root link's z axis points upwards, which most reward and termination terms require."""
        return self.up[2] >= _LEVEL


def survey(
    source: Path, env: Mapping[str, object], pose: Mapping[str, float], *, allow_missing: bool = False
) -> Survey:
    """Convert a robot, find the role of each joint, choose a default pose, and measure the robot in this pose.

    ``env`` contains the sections ``sim`` and ``scene``. ``pose`` maps expressions of joint names to positions, which
    replace those of the file. ``allow_missing`` permits missing wheels and collider files. An unreadable file, or a
    robot without joints, with a ball joint, a fixed base, or an implausible size raises AssetError.
    """
    with tempfile.TemporaryDirectory() as folder, named_as(Path(folder) / "model.xml", source):
        conversion = convert(source, Path(folder) / "model.xml", base="floating")
        if not conversion.description.dofs:
            raise AssetError("the robot has no joints", where=str(source), expected=_EXPECTED)
        balls = [dof.name for dof in conversion.description.dofs if dof.kind == "ball"]
        if balls:
            message = f"joint '{balls[0]}' is a ball joint, which no actuator drives"
            expected = "hinges and slides, or a fixed sphere as a ball caster"
            raise AssetError(message, where=str(source), expected=expected)
        names = [dof.name for dof in conversion.description.dofs]
        given = values_by_name(pose, names, None, key="env.robot.init_state.joint_pos", what="joint")
        read = {dof.name: _default_position(dof) for dof in conversion.description.dofs}
        chosen = read | {name: value for name, value in zip(names, given, strict=True) if value is not None}
        rotation = next(conversion.description.children(None)).pose.rotation
        robot = provisional_robot(conversion.description.name, rotation, chosen)
        scene = SceneManager({**env, "robot": robot}, conversion.output, 1).scene
        if not scene.robot.floating:
            message = f"joints connect the base to the world ({scene.robot.joint_names[0]}, ...), so the robot cannot "
            message += "stand or fall"
            raise AssetError(message, where=str(source), expected="a base that can move freely")
        model = scene.spec.compile()
        lost = missing_colliders(conversion.report, model)
        if lost and not allow_missing:
            raise AssetError(lost, where=str(source), expected="these files (git lfs pull), or --allow-missing")
        if not conversion.description.colliders:
            message = "no shape of the robot collides, so it would fall through the ground"
            raise AssetError(message, where=str(source), expected=_EXPECTED)
        sizes = [item.numbers for item in conversion.report.findings if item.kind == "implausible_size"]
        if sizes:
            raise AssetError(size_problem(**sizes[0]), where=str(source), expected="metres and kilograms")
        standing = None
        if not pose:
            data = at_default(model, scene.robot)
            limited, driven = with_written_limits(model, conversion.report), conversion.description.driven or None
            standing = stand(limited, anatomy_of(limited, data.qpos, driven), data.qpos)
            chosen |= standing.positions
            robot = provisional_robot(conversion.description.name, standing.rotation, chosen)
            scene = SceneManager({**env, "robot": robot | {"root_frame": standing.frame}}, conversion.output, 1).scene
            model = scene.spec.compile()
        found = _measured(conversion, scene.robot, model, standing)
        if found.facts.standing_height < 0:
            message = f"the root link '{found.anatomy.base}' is below the ground, on which the wheels stand"
            raise AssetError(message, where=str(source), expected="a root link inside the robot's body")
        for name, value in found.positions.items():
            low, high = model.joint(name).range if model.joint(name).limited else (-math.inf, math.inf)
            if not low - 1e-6 <= value <= high + 1e-6:
                message = f"a coupling moves joint '{name}' to {value:.4g}, beyond its limits {low:.4g} to {high:.4g}"
                raise AssetError(message, where=str(source), expected="a coupling that the limits allow")
        if (problem := found.anatomy.cannot_stand) and not allow_missing:
            expected = "wheels on both sides that can roll, or --allow-missing"
            raise AssetError(problem, where=str(source), expected=expected)
        if standing is not None and standing.lean:
            lean = f"{math.degrees(standing.lean):+.2g}°"
            found.notes.append(f"no leg pose brings the mass over the axle, so the base starts pitched by {lean}")
        return found


def _default_position(dof: Dof) -> float:
    """Return a position inside the limits: the saved position, else the drive's target, else the drawn position."""
    target = dof.drive.target_position if dof.drive is not None and dof.drive.stiffness > 0 else 0.0
    value = next((v for v in (dof.position, target, dof.ref) if v), 0.0)
    if dof.range is None:
        return value
    low, high = dof.range
    margin = (_OFF if low <= value <= high else _INSIDE) * (high - low)
    inside = min(max(value, low + margin), high - margin)
    rounded = float(f"{inside:.4g}")
    return rounded if low <= rounded <= high else inside


def _measured(conversion: Conversion, robot: Robot, model: mujoco.MjModel, standing: Standing | None) -> Survey:
    description = conversion.description
    by_name = {dof.name: dof for dof in description.dofs}
    dofs = {name: by_name[name] for name in robot.joint_names}
    data = at_default(model, robot)
    limited = with_written_limits(model, conversion.report)
    anatomy = anatomy_of(limited, data.qpos, description.driven or None)
    wheels = anatomy.wheel_joints
    driven, passive = _driven(description, dofs, anatomy)
    motor = Drive("", 1.0, 0.0, math.inf, math.inf)
    facts = measure(model, robot, anatomy, dict.fromkeys((*driven, *(w for w in wheels if w not in passive)), motor))
    limbs = {name for leg in anatomy.legs for name in (*leg.joints, *leg.beside)} if wheels else set(driven)
    legs = [name for name in driven if name in limbs]
    turned = [name for wheel in anatomy.wheels for name in wheel.bodies]
    lows = {name: lowest_point(model, data, [model.body(name).id]) for name in robot.body_names}
    touching = {min(wheel.bodies, key=lows.__getitem__) for wheel in anatomy.wheels}
    least = min(lows.values()) + _GROUND * facts.standing_height
    depths = sorted(overlap_depths(model, data, range(1, model.nbody)).items(), key=lambda item: -item[1])
    root = robot.body_names[0]
    fixed = np.flatnonzero(model.body_weldid == model.body_weldid[model.body(root).id])
    trunk = int(fixed[np.argmax(model.body_mass[fixed])])
    w, x, y, z = (float(f"{part:.6g}") for part in robot.default_root_quat.tolist())
    up_x, up_y, up_z = (round(float(part), 4) + 0.0 for part in data.body(root).xmat[6:9])
    mass_height = float(data.body(root).subtree_com[2] - data.body(root).xpos[2]) + facts.standing_height
    return Survey(
        dofs=dofs,
        legs=legs,
        held=[name for name in driven if name not in limbs],
        wheels=[name for name in dofs if name in wheels and name not in passive],
        passive=passive,
        positions={name: float(data.joint(name).qpos[0]) for name in dofs},
        rotation=(w, x, y, z),
        standing=standing,
        overlaps={(model.body(a).name, model.body(b).name): depth for (a, b), depth in depths},
        facts=facts,
        anatomy=anatomy,
        size=max(facts.standing_height, mass_height),
        up=(up_x, up_y, up_z),
        trunk=model.body(trunk).name,
        trunk_mass=float(model.body_mass[trunk]),
        wheel_bodies=[name for name in robot.body_names if name in touching],
        raised_bodies=[n for n, low in lows.items() if math.isfinite(low) and low > least and n not in turned],
        asymmetry=_asymmetry(model, robot, anatomy),
        notes=_notes(conversion, up_z >= _LEVEL, anatomy, legs, passive, missing_colliders(conversion.report, model)),
    )


def joint_pairs(anatomy: Anatomy) -> dict[str, str | None]:
    """Return the joints of one side, as expressions, with their mirror images."""
    return {name_expression(pair.left): pair.right for pair in anatomy.mirrored if pair.left != pair.right}


def _asymmetry(model: mujoco.MjModel, robot: Robot, anatomy: Anatomy) -> str | None:
    """Return why the policy of a robot cannot learn from mirror images, or None."""
    images = joint_images(robot.joint_names, joint_pairs(anatomy))
    try:
        joint_signs(model, robot.body_names[0], robot.joint_names, images)
    except ConfigError as error:
        return error.message
    return None


def _driven(robot: RobotDescription, dofs: Mapping[str, Dof], anatomy: Anatomy) -> tuple[list[str], list[str]]:
    """Return the names of the driven joints except wheels, and the names of the joints without a drive.

    If the robot file drives no leg joint, all leg joints except mimic joints count as driven. If the robot file drives
    no wheel, all wheels except mimic joints count as driven. Without a drive, casters and their swivels are passive.
    """
    followers = {c.joint for c in robot.couplings if dofs[c.joint].drive is None or dofs[c.reference].drive is not None}
    wheels = anatomy.wheel_joints
    passive: list[str] = []
    # Handle leg joints and wheels separately, because some robot files define drives only for legs or only for wheels.
    for group in ([name for name in dofs if name not in wheels], wheels):
        free = [name for name in group if name not in followers | anatomy.casters]
        driven = [name for name in group if name not in followers and name in robot.driven]
        passive += [name for name in group if name not in (driven or free)]
    return [name for name in dofs if name not in wheels and name not in passive], passive


def _notes(
    conversion: Conversion, upright: bool, anatomy: Anatomy, legs: Sequence[str], passive: Sequence[str], lost: str
) -> list[str]:
    notes = [*filter(None, [lost]), *conversion.report.warnings]
    if not upright:
        notes.append("the root link's z axis does not point up, so the task leaves out terms that require it")
    if not anatomy.wheels:
        text = "no joint is a wheel's (unlimited, about a level axis, last of its chain, with a round collider), so "
        notes.append(text + "the task has no wheels")
    lifted = [wheel.joint for wheel in anatomy.wheels if not wheel.stands]
    if lifted:
        count = f"only {len(anatomy.standing)} of {len(anatomy.wheels)} wheels"
        notes.append(f"{count} touch the ground in the default pose, not those of {', '.join(lifted)}")
    if anatomy.wheels and anatomy.forward is None:
        notes.append("the wheels' axles are not parallel, so the pose and the root link's frame are those of the file")
    notes += [f"'{name}' would be a wheel, but {why}" for name, why in anatomy.near.items()]
    if not legs:
        notes.append("no joint is a leg's, so the task drives only wheels")
    if passive:
        notes.append("joints without a drive: " + ", ".join(passive))
    return notes
