"""Diagnose a robot for the command ``wheelleg doctor``: list problems, the most urgent first, and notable facts.

A robot file is diagnosed on level ground with its own pose, drives, and limits. To measure the rewards of a task, the
task is simulated for two seconds with random actions.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch

from wheelleg_exp.anatomy import compiled_robot as robots
from wheelleg_exp.anatomy.collider_shapes import find_overlaps, lowest_point
from wheelleg_exp.anatomy.stance import weight_over_axle
from wheelleg_exp.asset import Conversion, convert
from wheelleg_exp.asset.file_limits import require_plain_file
from wheelleg_exp.asset.mjcf.coupled_positions import JointCouplings
from wheelleg_exp.asset.robot_description import Dof
from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.config.schema import Experiment
from wheelleg_exp.errors import AssetError, named_as
from wheelleg_exp.lint.physics_check import RULES, examine
from wheelleg_exp.lint.rule import Case, Finding
from wheelleg_exp.managers import SceneManager
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.terms.config_sections import read_section

_ENVS, _SECONDS = 32, 2.0


def random_rewards(composed: Composed) -> Mapping[str, float]:
    """Return each reward's mean per second under standard normal actions: 2 s in 32 environments of a valid config."""
    config = composed.config
    env = build_env({**config, "env": {**config["env"], "num_envs": _ENVS}}, composed.asset_roots)
    stream = torch.Generator(device=env.device).manual_seed(int(config["seed"]))
    env.reset()
    steps = max(1, round(_SECONDS / env.step_dt))
    total = torch.zeros(len(env.reward_manager.active_terms), device=env.device)
    for _ in range(steps):
        shape = (_ENVS, env.action_manager.total_action_dim)
        env.step(torch.randn(shape, generator=stream, device=env.device))
        total += env.reward_manager.step_reward.mean(dim=1)
    return dict(zip(env.reward_manager.active_terms, (total / steps).tolist(), strict=True))


_MJCF = (".xml", ".mjcf")
_ENDLESS = 1e6  # An effort or speed limit above 1e6 in a robot file means that the joint is unlimited.
_MOVED = 1e-6  # rad or m


def case_of_file(source: Path) -> Case:
    """Return the case of a robot file (USD, URDF, MJCF): the robot in the file's pose with its own drives."""
    with tempfile.TemporaryDirectory() as folder, named_as(Path(folder) / "model.xml", source):
        if source.suffix.lower() in _MJCF:
            require_plain_file(source, "an MJCF file")
            try:
                model = mujoco.MjModel.from_xml_path(str(source))
            except ValueError as error:
                message = f"MuJoCo cannot read the robot file: {' '.join(str(error).split())}"
                raise AssetError(message, where=str(source)) from None
            return _file_case(source, _robot_of_mjcf(source, model), _drives_of_mjcf(model))
        conversion = convert(source, Path(folder) / "model.xml", base="floating")
        described = conversion.description
        positions = {dof.name: dof.position for dof in described.dofs if dof.kind != "ball"}
        robot = robots.provisional_robot(described.name, next(described.children(None)).pose.rotation, positions)
        followers = {coupling.joint for coupling in described.couplings}
        drives = {d.name: None if d.drive is None and d.name in followers else _drive(d) for d in described.dofs}
        return _file_case(source, robot, drives, conversion)


def _file_case(
    source: Path, robot: Mapping[str, object], drives: robots.Drives, conversion: Conversion | None = None
) -> Case:
    stock = read_section(Experiment, compose(["task=stand"]).config, "")
    env = replace(
        stock.env,
        robot=read_section(RobotOptions, robot, "env.robot"),
        scene=replace(stock.env.scene, sensors={}),
        commands={},
        actions={},
        observations={},
        events={},
        rewards={},
        terminations={},
        curriculum={},
    )
    scene = SceneManager(env, conversion.output if conversion else source, 1).scene
    if not scene.robot.joint_names:
        expected = "a robot with joints to drive"
        raise AssetError("the robot has no joints", where=str(source), expected=expected)
    model, layout = scene.spec.compile(), scene.robot.layout
    bodies = [model.body(name).id for name in scene.robot.body_names]
    lowest = lowest_point(model, robots.at_default(model, scene.robot), bodies)
    # Set the robot's lowest point on the ground, because a robot file contains no start height.
    if math.isfinite(lowest) and scene.robot.floating:
        layout.default_root_pos[2] -= lowest
    driven = conversion.description.driven if conversion else list(drives)
    found, _ = robots.compiled_robot(model, scene.robot, conversion.report if conversion else None, driven)
    facts = robots.measure(model, scene.robot, found.anatomy, drives)
    joints = {}
    for name, joint in facts.joints.items():
        group = "wheels" if name in facts.wheels else "legs"
        joints[name] = replace(joint, drive=None if joint.drive is None else replace(joint.drive, group=group))
    drawn = dict(zip(layout.joint_names, layout.default_joint_pos.tolist(), strict=True))
    free = [name for name in drawn if model.joint(name).id not in JointCouplings(model).followers]
    moved = {name: drawn[name] for name in free if abs(found.position(name) - drawn[name]) > _MOVED}
    config = replace(stock, env=env)
    return Case(config, replace(facts, joints=joints), replace(found, moved=moved), of_task=False)


def _drive(dof: Dof) -> robots.Drive | None:
    """Return a joint's drive from the robot file. A missing limit means unlimited."""
    effort = dof.effort
    if dof.drive is None and effort is None and dof.max_velocity is None:
        return None
    stiffness, damping = (dof.drive.stiffness, dof.drive.damping) if dof.drive is not None else (0.0, 0.0)
    return robots.Drive("", stiffness, damping, _limit(effort), _limit(dof.max_velocity))


def _limit(value: float | None) -> float:
    return value if value is not None and value < _ENDLESS else math.inf


def _robot_of_mjcf(source: Path, model: mujoco.MjModel) -> dict[str, object]:
    """Return an ``env.robot`` section for an MJCF file, with the pose of the first keyframe or else the zero pose."""
    qpos = model.key_qpos[0] if model.nkey else model.qpos0
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    scalar = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) | (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)
    positions: dict[str, float] = {}
    for joint in np.flatnonzero(scalar).tolist():
        name = model.joint(joint).name
        if not name:
            message = "a joint of the robot has no name"
            raise AssetError(message, where=str(source), expected="a name for every joint and body")
        positions[name] = float(qpos[model.jnt_qposadr[joint]])
    start = int(model.jnt_qposadr[free[0]]) + 3 if len(free) else None
    rotation = qpos[start : start + 4].tolist() if start is not None else [1.0, 0.0, 0.0, 0.0]
    return robots.provisional_robot(source.stem, rotation, positions)


def _drives_of_mjcf(model: mujoco.MjModel) -> dict[str, robots.Drive | None]:
    """Return the drive of each joint with actuators: the sums of their gains and efforts, limited by the joint."""
    drives: dict[str, robots.Drive | None] = {}
    for joint in range(model.njnt):
        own = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
        parts = [_actuator(model, index) for index in np.flatnonzero(own).tolist()]
        if not parts:
            continue
        stiffness, damping, effort = (sum(values) for values in zip(*parts, strict=True))
        damping += float(model.dof_damping[model.jnt_dofadr[joint]])
        if model.jnt_actfrclimited[joint]:
            effort = min(effort, float(np.abs(model.jnt_actfrcrange[joint]).max()))
        drives[model.joint(joint).name] = robots.Drive("", stiffness, damping, effort, math.inf)
    return drives


def _actuator(model: mujoco.MjModel, index: int) -> tuple[float, float, float]:
    """Return the stiffness (N·m/rad), damping (N·m·s/rad), and largest torque (N·m) of an actuator at its joint."""
    gear = abs(float(model.actuator_gear[index, 0]))
    limits = [math.inf]
    if model.actuator_forcelimited[index]:
        limits.append(gear * float(np.abs(model.actuator_forcerange[index]).max()))
    bias = model.actuator_biasprm[index]
    if model.actuator_ctrllimited[index] and not bias.any():  # Without bias, an actuator's torque is gain · control.
        gain = gear * float(model.actuator_gainprm[index, 0])
        limits.append(gain * float(np.abs(model.actuator_ctrlrange[index]).max()))
    return gear**2 * -float(bias[1]) + 0.0, gear**2 * -float(bias[2]) + 0.0, min(limits)


# Rules about basic errors are first, because wrong masses, for example, cause wrong findings about drives.
OF_ROBOT = (
    "missing_files", "no_colliders", "lost_in_conversion", "assumed_masses", "robot_size", "link_masses",
    "wheels_that_do_not_roll", "rolling_direction", "overlapping_bodies", "mirror_images", "wheel_senses",
    "joint_limits", "balance_pose", "placeholder_limits", "effort_against_load", "weak_wheels",
    "gains_against_time_step", "armature_ratio",
)  # fmt: skip
OF_TASK = (
    *OF_ROBOT,
    "effort_against_traction", "lopsided_pose", "contact_at_start", "spawn_height", "reset_into_ground",
    "episode_end", "target_height", "contact_threshold", "action_scale", "command_reach", "drive_bandwidth",
    "control_rate", "falling_pays", "reward_outweighs",
)  # fmt: skip


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of a robot: findings, most urgent first, facts, and silenced findings with the config's reasons."""

    subject: str
    case: Case
    findings: tuple[Finding, ...]
    silenced: tuple[tuple[Finding, str], ...]
    notes: tuple[str, ...]

    @property
    def first(self) -> str:
        """Return the diagnosis's most urgent finding as one line of text."""
        if not self.findings:
            return f"{self.subject}: nothing to fix"
        finding = self.findings[0]
        return f"first: {finding.message}; {finding.hint}"

    def document(self) -> dict[str, object]:
        robot = self.case.robot
        return {
            "subject": self.subject,
            "findings": [{**asdict(finding), "known_by": known_by(finding)} for finding in self.findings],
            "silenced": [{**asdict(finding), "reason": reason} for finding, reason in self.silenced],
            "notes": list(self.notes),
            "first": self.first,
            "facts": asdict(self.case.facts),
            "anatomy": asdict(robot.anatomy) if robot is not None else None,
        }


def diagnose_file(source: Path) -> Diagnosis:
    """Diagnose a robot's USD, URDF, or MJCF file. An unreadable file raises AssetError."""
    case = case_of_file(source)
    found = [finding for name in OF_ROBOT for finding in RULES[name](case)]
    return Diagnosis(str(source), case, tuple(found), (), tuple(notes_on(case)))


def diagnose_task(composed: Composed) -> Diagnosis:
    """Diagnose a task's robot, its start pose, and its drives. ``composed`` must be valid."""
    report = examine(composed)
    case = replace(report.case, trial=random_rewards(composed))
    tried = [replace(f, where=composed.provenance.where(f.key)) for f in RULES["reward_outweighs"](case)]
    order = {name: place for place, name in enumerate(OF_TASK)}
    ours = sorted((f for f in (*report.findings, *tried) if f.rule in order), key=lambda finding: order[finding.rule])
    silenced = tuple((finding, report.reasons[finding.rule]) for finding in ours if report.silences(finding))
    found = tuple(finding for finding in ours if not report.silences(finding))
    subject = f"task={report.case.config.task.name}"
    return Diagnosis(subject, report.case, found, silenced, tuple(notes_on(report.case)))


def known_by(finding: Finding) -> str:
    """Return the source, such as a paper, that the docstring of a finding's rule cites."""
    _, _, source = " ".join(RULES[finding.rule].text.split()).partition("Source: ")
    return source.rstrip(".")


def notes_on(case: Case) -> list[str]:
    """Return remarks about a robot that are useful to the user but do not describe a fault."""
    robot = case.robot
    if robot is None:
        return []
    anatomy = robot.anatomy
    count = f"{len(anatomy.wheels)} {'wheel' if len(anatomy.wheels) == 1 else 'wheels'}"
    if not anatomy.wheels:
        notes = ["no wheels: no low hinge without limits at the end of a chain turns a round part about a level axis"]
    elif anatomy.forward is None:
        notes = [f"{count}, which do not roll in one direction"]
    else:
        x, y, z = (round(part, 3) + 0.0 for part in anatomy.forward)
        notes = [f"{count}; forwards is ({x:g}, {y:g}, {z:g}) in the base '{anatomy.base}'"]
    if robot.moved:
        pose = ", ".join(f"{name} at {robot.position(name):.4g}, not {at:.4g}" for name, at in robot.moved.items())
        notes.append(f"the file's pose is outside joint limits, so the robot is measured with {pose}")
    kinds = {w.joint: f"a caster behind {' and '.join(w.swivels)}" if w.caster else "a wheel" for w in anatomy.wheels}
    notes += [f"{w.joint}: {kinds[w.joint]}, {w.side}, because it {w.why}" for w in anatomy.wheels]
    loops = sum(len(leg.loops) for leg in anatomy.legs)
    if loops:
        notes.append(f"{loops} closed loops in the legs: their joints share the load and move together")
    if anatomy.forward is not None and anatomy.one_axle:
        weight = weight_over_axle(robot)
        note = f"the centre of mass above the wheels: {1e3 * weight.ahead:+.1f} mm along forwards, "
        note += f"{1e3 * weight.above:.4g} mm over the axle, a lean of {math.degrees(weight.lean):+.1f}°"
        notes.append(note)
    signs = {wheel.joint: wheel.sign for wheel in robot.drawn.wheels if wheel.sign}
    backwards = [name for name, sign in signs.items() if sign < 0]
    if backwards and len(backwards) < len(signs):
        notes += [f"positive speed rolls backwards on {', '.join(backwards)}: scales of opposite signs drive straight"]
    return notes + _self_collisions(robot)


def _self_collisions(robot: robots.CompiledRobot) -> list[str]:
    pairs = find_overlaps(robot.model, robot.data.qpos, robot.bodies)
    hidden = [pair for pair in pairs if not pair.acts and not pair.neighbours]
    if not hidden:
        return []
    one, other = hidden[0].bodies
    count = "1 pair of bodies" if len(hidden) == 1 else f"{len(hidden)} pairs of bodies"
    note = f"self_collisions: true would start with {count} that overlap, the deepest '{one}' and '{other}' by "
    return [note + f"{1e3 * hidden[0].depth:.3g} mm"]


def rows_of(findings: Sequence[Finding], reasons: Mapping[str, str] | None = None) -> list[tuple[str, ...]]:
    """Return findings as rows of text: rule, key, place, message, hint, and source (or the reason of the silence)."""
    known = reasons or {}
    return [(f.rule, f.key, f.where or "", f.message, f.hint, known.get(f.rule) or known_by(f)) for f in findings]
