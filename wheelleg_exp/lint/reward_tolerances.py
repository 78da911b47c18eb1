"""Compute the value of each reward term for an acceptable error of the robot, such as a tenth of the height."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
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
CONTACTS = ("rewards.no_contact_count", "rewards.undesired_contacts", "rewards.no_desired_contact")


@dataclass(frozen=True)
class Contribution:
    """The output of a reward term for a robot with an acceptable error (``tolerance``), such as a tilt of 0.1 rad.

    ``value`` is the term's unweighted output for a robot with an acceptable error; None if unknown. ``cost`` is the
    absolute difference between ``value`` and the term's output for a robot without error. If ``once`` is true, the
    reward is given once per episode instead of at each control step.
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
        return (self.value or 0.0) + (self.cost if self.term.kind in (*TRACKING, *_KERNELS) else 0.0)

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
    if term.kind in _KERNELS:
        text, square = _KERNELS[term.kind](case, term)
        value = _bell(math.sqrt(square), term)
        return Contribution(term, weight, text, value, 1.0 - value)
    known = _SQUARES.get(term.kind)
    if known is None:
        return Contribution(term, weight, "", None)
    text, value = known(case, term)
    return Contribution(term, weight, text, value, value)


def _bell(error: float, term: TermView) -> float:
    ratio = error / float(term.node["std"])
    return math.exp(-ratio * ratio)


def command_size(case: Case, term: TermView) -> float:
    """Return the largest command that a reward term tracks, m/s or rad/s."""
    ranges = case.env.commands.get(str(term.node["command_name"]), {}).get("ranges")
    axes = ("lin_vel_x", "lin_vel_y") if TRACKING[term.kind] == "lin" else ("ang_vel_z",)
    return max((largest(ranges.get(axis)) for axis in axes), default=0.0) if isinstance(ranges, Mapping) else 0.0


def _body_height(case: Case) -> float:
    """Return the robot's standing height in m, but at least 0.01 m, because an arm's base can be on the ground."""
    return max(case.facts.standing_height, 0.01)


def _height(_case: Case, term: TermView) -> tuple[str, float]:
    error = SHARE * float(term.node["target_height"])
    return f"{1e3 * error:.3g} mm, a tenth of the height", error**2


def _vertical(case: Case, _term: TermView) -> tuple[str, float]:
    error = SHARE * math.sqrt(case.facts.gravity * _body_height(case))
    return f"{error:.2g} m/s, a tenth of sqrt(g h)", error**2


def _rocking(case: Case, _term: TermView) -> tuple[str, float]:
    error = SHARE * math.sqrt(case.facts.gravity / _body_height(case))
    return f"{error:.2g} rad/s, a tenth of sqrt(g/h)", error**2


def _tilt(_case: Case, _term: TermView) -> tuple[str, float]:
    return f"{ANGLE} rad", math.sin(ANGLE) ** 2


def _deviation(case: Case, term: TermView) -> tuple[str, float]:
    count = len(case.joints(term.node))
    return f"{ANGLE} rad on {count} joints", ANGLE * count


def _symmetry(case: Case, term: TermView) -> tuple[str, float]:
    count = len(case.joints(term.node, "left_cfg"))
    return f"{ANGLE} rad on {count} pairs", ANGLE * count


def _torques(case: Case, term: TermView) -> tuple[str, float]:
    efforts = [joint.drive.effort for joint in case.joints(term.node).values() if joint.drive is not None]
    return "a tenth of the effort limits", sum((SHARE * effort) ** 2 for effort in efforts)


def _action_rate(case: Case, _term: TermView) -> tuple[str, float]:
    width = sum(len(case.joints(action.node)) for action in case.terms("actions"))
    return f"{ACTION} of a unit on {width} actions", width * ACTION**2


def _travel(case: Case, term: TermView) -> tuple[str, float]:
    most = case.env.commands.get(str(term.node["command_name"]), {}).get("max_travel_error", 0.0)
    return f"{1e3 * SHARE * most:.3g} mm, a tenth of the largest sum", (SHARE * most) ** 2


# For reward terms of the form exp(-error² / std²), ``_KERNELS`` contains functions that return an acceptable error².
_KERNELS: Mapping[str, Callable[[Case, TermView], tuple[str, float]]] = {
    "rewards.base_height_exp": _height,
    "rewards.flat_orientation_exp": _tilt,
}

_SQUARES: Mapping[str, Callable[[Case, TermView], tuple[str, float]]] = {
    **dict.fromkeys(HEIGHTS, _height),
    "rewards.lin_vel_z_l2": _vertical,
    "rewards.ang_vel_xy_l2": _rocking,
    "rewards.pitch_orientation_l2": _tilt,
    "rewards.flat_orientation_l2": _tilt,
    "rewards.joint_deviation_l1": _deviation,
    "rewards.stand_still_joint_deviation_l1": _deviation,
    "rewards.joint_symmetry_l1": _symmetry,
    "rewards.joint_torques_l2": _torques,
    "rewards.travel_error_l2": _travel,
    "rewards.action_rate_l2": _action_rate,
    "rewards.action_l2": _action_rate,
    "rewards.action_acceleration_l2": _action_rate,
    **dict.fromkeys(CONTACTS, lambda _case, _term: ("one body", 1.0)),
}
