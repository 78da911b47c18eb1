"""What an expert says of a robot: findings with the most urgent first, and what there is to know of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.examine import RULES, examine, facts_rows
from wheelleg_exp.lint.findings import Finding
from wheelleg_exp.lint.robot.balancing import weight_over_axle
from wheelleg_exp.lint.robot.compiled import CompiledRobot
from wheelleg_exp.lint.robot.from_file import case_of_file
from wheelleg_exp.lint.robot.overlaps import find_overlaps
from wheelleg_exp.lint.trial import random_rewards

# What is to be mended first stands first: nothing that follows means much before it.
OF_ROBOT = (
    "no_colliders",
    "missing_files",
    "lost_in_conversion",
    "assumed_masses",
    "robot_size",
    "link_masses",
    "wheels_that_do_not_roll",
    "rolling_direction",
    "overlapping_bodies",
    "mirror_images",
    "wheel_senses",
    "joint_limits",
    "balance_pose",
    "placeholder_limits",
    "effort_against_load",
    "weak_wheels",
    "gains_against_time_step",
    "armature_ratio",
)
OF_TASK = (
    *OF_ROBOT,
    "effort_against_traction",
    "lopsided_pose",
    "contact_at_start",
    "spawn_height",
    "reset_into_ground",
    "episode_end",
    "target_height",
    "contact_threshold",
    "action_scale",
    "command_reach",
    "drive_bandwidth",
    "control_rate",
    "falling_pays",
    "reward_outweighs",
)


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        subject: the file or the task.
        case: what was looked at.
        findings: the most urgent first; those that the task silences are left out.
        silenced: findings that the task silences, with its reasons.
        notes: what is no fault and good to know.
    """

    subject: str
    case: Case
    findings: tuple[Finding, ...]
    silenced: tuple[tuple[Finding, str], ...]
    notes: tuple[str, ...]

    @property
    def first(self) -> str:
        """The one line to act on first."""
        if not self.findings:
            return f"{self.subject}: nothing to mend"
        finding = self.findings[0]
        return f"first: {finding.message}; {finding.hint}"

    def facts(self) -> list[tuple[str, str, str]]:
        """Return the robot's facts: name, value, unit."""
        return facts_rows(self.case.facts)

    def document(self) -> dict[str, Any]:
        """Return all of it for scripts."""
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
    """Look at a robot's file.

    Args:
        source: a USD, URDF or MJCF file.

    Raises:
        AssetError: the file cannot be read, or holds no robot with joints.
    """
    return diagnose_case(str(source), case_of_file(source))


def diagnose_case(subject: str, case: Case) -> Diagnosis:
    """Look at a robot without a task; see ``case_of_file``."""
    found = [finding for name in OF_ROBOT for finding in RULES[name](case)]
    return Diagnosis(subject, case, tuple(found), (), tuple(notes_on(case)))


def diagnose_task(composed: Composed) -> Diagnosis:
    """Look at a task's robot, its start and its drives.

    Args:
        composed: a config without mistakes.

    Raises:
        WheellegError: the robot cannot be read, or the scene cannot be built.
    """
    report = examine(composed)
    case = replace(report.case, trial=random_rewards(composed))
    tried = [replace(f, where=composed.provenance.where(f.key)) for f in RULES["reward_outweighs"](case)]
    order = {name: place for place, name in enumerate(OF_TASK)}
    ours = sorted((f for f in (*report.findings, *tried) if f.rule in order), key=lambda finding: order[finding.rule])
    silenced = tuple((finding, report.reasons[finding.rule]) for finding in ours if finding.rule in report.reasons)
    found = tuple(finding for finding in ours if finding.rule not in report.reasons)
    subject = f"task={report.case.config['task']['name']}"
    return Diagnosis(subject, report.case, found, silenced, tuple(notes_on(report.case)))


def known_by(finding: Finding) -> str:
    """Return what a rule's finding rests on: the source that its text names."""
    _, _, source = RULES[finding.rule].text.partition("Source: ")
    return " ".join(source.split()).rstrip(".")


def notes_on(case: Case) -> list[str]:
    """Return what is no fault and good to know of a robot."""
    robot = case.robot
    if robot is None:
        return []
    anatomy = robot.anatomy
    notes = [_way(robot)]
    notes += [f"{w.joint}: a wheel, {w.side}, because it {w.why}" for w in anatomy.wheels]
    loops = sum(len(leg.loops) for leg in anatomy.legs)
    if loops:
        notes.append(f"{loops} closed loops in the legs: their joints share the load, and move together")
    if anatomy.forward is not None and anatomy.one_axle:
        weight = weight_over_axle(robot)
        notes.append(
            f"the centre of mass above the wheels: {1e3 * weight.ahead:+.1f} mm along forwards, "
            f"{1e3 * weight.above:.4g} mm over the axle, a lean of {math.degrees(weight.lean):+.1f}°"
        )
    notes += _opposite(robot)
    return notes + _self_collisions(robot)


def _way(robot: CompiledRobot) -> str:
    anatomy = robot.anatomy
    if not anatomy.wheels:
        return "no wheels: no hinge without limits turns something round about a level axis, low and last of its chain"
    count = f"{len(anatomy.wheels)} {'wheel' if len(anatomy.wheels) == 1 else 'wheels'}"
    if anatomy.forward is None:
        return f"{count}, which roll along no common line"
    x, y, z = anatomy.forward
    return f"{count}; forwards is ({x:.3g}, {y:.3g}, {z:.3g}) of the base '{anatomy.base}'"


def _opposite(robot: CompiledRobot) -> list[str]:
    signs = {wheel.joint: wheel.sign for wheel in robot.drawn.wheels if wheel.sign}
    backwards = [name for name, sign in signs.items() if sign < 0]
    if backwards and len(backwards) < len(signs):
        return [f"positive speed rolls backwards on {', '.join(backwards)}: scales of opposite signs drive straight on"]
    return []


def _self_collisions(robot: CompiledRobot) -> list[str]:
    pairs = find_overlaps(robot.model, robot.data.qpos, robot.bodies)
    hidden = [pair for pair in pairs if not pair.acts and not pair.neighbours]
    if not hidden:
        return []
    one, other = hidden[0].bodies
    count = "1 pair of bodies" if len(hidden) == 1 else f"{len(hidden)} pairs of bodies"
    return [
        f"self_collisions: true would begin with {count} inside one another, the deepest '{one}' and '{other}' by "
        f"{1e3 * hidden[0].depth:.3g} mm"
    ]


def rows_of(findings: Sequence[Finding], reasons: Mapping[str, str] | None = None) -> list[tuple[str, ...]]:
    """Return findings in words: rule, key, place, what, what to write, how it is known (or why it is silenced)."""
    return [
        (f.rule, f.key, f.where or "", f.message, f.hint, (reasons or {}).get(f.rule) or known_by(f)) for f in findings
    ]
