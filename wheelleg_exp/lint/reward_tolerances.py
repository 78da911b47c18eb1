"""Compute the value of each reward term for an acceptable error of the robot, such as a tenth of the height."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from wheelleg_exp.lint.rule import Case, TermView, largest

ANGLE = 0.1  # rad, 6 degrees
SHARE = 0.1  # An acceptable error is 10 % of, for example, the robot's height or the commanded velocity.
ACTION = 0.5  # An acceptable error of the policy's raw action is 0.5.

TRACKING = {
    "rewards.track_lin_vel_xy_exp": "lin",
    "rewards.track_lin_vel_xy_yaw_frame_exp": "lin",
    "rewards.track_ang_vel_z_exp": "ang",
    "rewards.track_ang_vel_z_world_exp": "ang",
}
UNITS = {"lin": "m/s", "ang": "rad/s"}
HEIGHTS = ("rewards.base_height_l2", "rewards.base_height_over_ground_l2")
FAILURES = ("rewards.is_terminated", "rewards.is_terminated_term")
# These reward terms have the form exp(-error² / std²).
_BELLS = ("rewards.base_height_exp", "rewards.flat_orientation_exp")


@dataclass(frozen=True)
class Contribution:
    """The output of a reward term for a robot with an acceptable error (``tolerance``), such as a tilt of 0.1 rad.

    ``value`` is the unweighted output for that robot; None if unknown. ``cost`` is its difference from the output for a
    robot without error. If ``once`` is true, the reward is given once per episode instead of at each control step.
    """

    term: TermView
    weight: float
    tolerance: str
    value: float | None
    cost: float = 0.0
    once: bool = False

    @property
    def best(self) -> float:
        """The unweighted output of the reward term for a robot without tracking or posture errors."""
        return (self.value or 0.0) + (self.cost if self.term.kind in (*TRACKING, *_BELLS) else 0.0)

    def per_step(self, step_dt: float) -> float:
        """Return the reward of one control step: the product of weight, value, and control time step."""
        return self.weight * (self.value or 0.0) * step_dt

    def per_episode(self, case: Case) -> float:
        """Return the reward that a term gives in a whole episode for an acceptable error of the robot."""
        return self.per_step(case.step_dt) * (1 if self.once else case.episode_steps)


def contributions(case: Case) -> list[Contribution]:
    """Return the output of each reward term for a robot with an acceptable error, such as a tilt of 0.1 rad."""
    return [_contribution(case, term) for term in case.terms("rewards")]


def earned_per_second(found: list[Contribution]) -> float:
    """Return the reward of a perfect robot per second: the terms with positive weight at their best value."""
    return sum(c.weight * c.best for c in found if c.weight > 0.0 and not c.once)


def _contribution(case: Case, term: TermView) -> Contribution:
    weight = float(term.node["weight"])
    if term.kind == "rewards.is_alive":
        return Contribution(term, weight, "being alive", 1.0)
    if term.kind in FAILURES:
        return Contribution(term, weight, "one failure", 1.0, 1.0, once=True)
    if term.kind in TRACKING:
        error = SHARE * command_size(case, term)
        if error == 0.0:
            return Contribution(term, weight, "no error: nothing is commanded", 1.0)
        value = _bell(error, term)
        text = f"{error:.3g} {UNITS[TRACKING[term.kind]]}, a tenth of the command"
        return Contribution(term, weight, text, value, 1.0 - value)
    text, size = _acceptable(case, term)
    if size is not None and term.kind in _BELLS:
        value = _bell(math.sqrt(size), term)
        return Contribution(term, weight, text, value, 1.0 - value)
    return Contribution(term, weight, text, size, size or 0.0)


def _bell(error: float, term: TermView) -> float:
    ratio = error / float(term.node["std"])
    return math.exp(-ratio * ratio)


def command_size(case: Case, term: TermView) -> float:
    """Return the largest command that a reward term tracks, m/s or rad/s."""
    ranges = case.env.commands.get(str(term.node["command_name"]), {}).get("ranges")
    axes = ("lin_vel_x", "lin_vel_y") if TRACKING[term.kind] == "lin" else ("ang_vel_z",)
    return max((largest(ranges.get(axis)) for axis in axes), default=0.0) if isinstance(ranges, Mapping) else 0.0


def _acceptable(case: Case, term: TermView) -> tuple[str, float | None]:
    """Return an acceptable error, and its square or the sum that the reward term penalises; None if unknown."""
    node, facts, name = term.node, case.facts, term.kind.removeprefix("rewards.")
    height = max(facts.standing_height, 0.01)  # m; an arm's base can be on the ground.
    if name in ("base_height_l2", "base_height_over_ground_l2", "base_height_exp"):
        error = SHARE * float(node["target_height"])
        return f"{1e3 * error:.3g} mm, a tenth of the height", error**2
    if name == "lin_vel_z_l2":
        error = SHARE * math.sqrt(facts.gravity * height)
        return f"{error:.2g} m/s, a tenth of sqrt(g h)", error**2
    if name == "ang_vel_xy_l2":
        error = SHARE * math.sqrt(facts.gravity / height)
        return f"{error:.2g} rad/s, a tenth of sqrt(g/h)", error**2
    if name in ("pitch_orientation_l2", "flat_orientation_l2", "flat_orientation_exp"):
        return f"{ANGLE} rad", math.sin(ANGLE) ** 2
    if name in ("joint_deviation_l1", "stand_still_joint_deviation_l1"):
        count = len(case.joints(node))
        return f"{ANGLE} rad on {count} joints", ANGLE * count
    if name == "joint_symmetry_l1":
        count = len(case.joints(node, "left_cfg"))
        return f"{ANGLE} rad on {count} pairs", ANGLE * count
    if name == "joint_torques_l2":
        efforts = [joint.drive.effort for joint in case.joints(node).values() if joint.drive is not None]
        return "a tenth of the effort limits", sum((SHARE * effort) ** 2 for effort in efforts)
    if name == "travel_error_l2":
        most = case.env.commands.get(str(node["command_name"]), {}).get("max_travel_error", 0.0)
        return f"{1e3 * SHARE * most:.3g} mm, a tenth of the largest sum", (SHARE * most) ** 2
    if name in ("action_rate_l2", "action_l2", "action_acceleration_l2"):
        width = sum(len(case.joints(action.node)) for action in case.terms("actions"))
        return f"{ACTION} of a unit on {width} actions", width * ACTION**2
    if name in ("no_contact_count", "undesired_contacts", "no_desired_contact"):
        return "one body", 1.0
    return "", None
