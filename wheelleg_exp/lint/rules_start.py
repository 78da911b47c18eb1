"""Where episodes begin and end."""

from __future__ import annotations

import math
from collections.abc import Iterator

from wheelleg_exp.lint.case import Case, TermView, largest
from wheelleg_exp.lint.findings import Finding, above, at_least, at_most, below, rule
from wheelleg_exp.lint.reward_tolerances import HEIGHTS

_DROP = 0.1  # of the standing height
_GROUND = 1e-4  # m that a spawn may lie inside the ground: contacts are soft
_HEIGHT = 0.05  # of the standing height, between the reward's target and the default pose
_FALLS = 5.0  # time constants of the fall that an episode should last
_UPRIGHT = math.pi
_LOWEST = ("terminations.root_height_below_minimum", "terminations.root_height_over_ground_below_minimum")
_TIMES = ("rewards.feet_air_time", "rewards.feet_air_time_positive_biped")  # whose threshold is in seconds
_ON_WHEELS = (
    "rewards.no_contact_count",
    "rewards.no_desired_contact",
    "rewards.feet_slide",
    "rewards.wheel_slip",
    "rewards.wheel_spin_in_air_l1",
)


@rule
def spawn_height(case: Case) -> Iterator[Finding]:
    """A robot that begins inside the ground, or well above it.

    The lowest point of the default pose, from the colliding shapes, is held against the ground: inside it the
    contact throws the robot, above it the robot falls and lands at sqrt(2 g h). Source: kinematics.
    """
    facts = case.facts
    clearance, limit = facts.clearance, _DROP * facts.standing_height
    if not math.isfinite(clearance) or -_GROUND <= clearance <= limit:
        return
    x, y, height = map(float, case.env["robot"]["init_state"]["pos"])
    right = at_least(round(height - clearance, 9), 4)
    if clearance < 0:
        text = f"the lowest point begins {-1e3 * clearance:.3g} mm inside the ground"
        figures = {"clearance_m": clearance}
    else:
        speed = math.sqrt(2 * facts.gravity * clearance)
        text = f"the robot begins {1e3 * clearance:.3g} mm above the ground and lands at {speed:.2f} m/s"
        figures = {"clearance_m": clearance, "landing_m_s": speed}
    key, hint = "env.robot.init_state.pos", f"a height of {right:g} m stands it on the ground"
    yield Finding(key, text, hint, figures, ({key: [x, y, right]},))


@rule
def target_height(case: Case) -> Iterator[Finding]:
    """A rewarded height that the default pose does not have.

    The policy would have to leave the pose that its actions and the other rewards start from. Source: kinematics of
    the default pose.
    """
    standing = case.facts.standing_height
    for term in case.terms("rewards", *HEIGHTS):
        target = float(term.node["target_height"])
        if abs(target - standing) > _HEIGHT * standing:
            key, right = f"{term.path}.target_height", at_least(standing, 3)
            yield Finding(
                key,
                f"{1e3 * target:.4g} mm, and the default pose stands {1e3 * standing:.4g} mm high",
                f"{right:g} m, or another default pose",
                {"target_m": target, "standing_m": standing},
                ({key: right},),
            )


@rule
def contact_threshold(case: Case) -> Iterator[Finding]:
    """A contact threshold that is large for the robot's weight.

    1 N is nothing for a robot of 50 kg and a fifth of one that weighs 0.5 kg. Contact of one body is to be noticed
    at a tenth of the weight; a wheel at less than half of its load. Source: statics.
    """
    weight, load = case.facts.weight, case.facts.wheel_load
    for section in ("terminations", "rewards"):
        for term in case.terms(section):
            threshold = term.node.get("threshold")
            stock = term.kind.startswith(("rewards.", "terminations.")) and term.kind not in _TIMES
            if not isinstance(threshold, (int, float)) or not stock:
                continue
            wheels = term.kind in _ON_WHEELS
            limit = 0.5 * load if wheels else 0.1 * weight
            if threshold > limit:
                key, most = f"{term.path}.threshold", at_most(limit)
                yield Finding(
                    key,
                    f"{threshold:g} N is {100 * threshold / weight:.0f} % of the robot's weight of {weight:.3g} N",
                    f"at most {most:g} N",
                    {"threshold": float(threshold), "weight": weight},
                    ({key: most},),
                )


@rule
def episode_end(case: Case) -> Iterator[Finding]:
    """An episode that cannot end rightly, ends at once, or is over before the robot can fall.

    Without a time-out the value of what follows is cut off; a limit that the start already breaks ends every
    episode in its first step; a robot that falls with a time constant of 1/p needs several of them to fail.
    Source: the theory of truncation, Pardo et al., "Time limits in reinforcement learning", 2018.
    """
    terms = list(case.terms("terminations"))
    if not any(term.node.get("time_out", False) for term in terms):
        yield Finding(
            "env.terminations",
            "no termination is a time-out: the end of an episode would count as a failure, or never come",
            "the termination time_out, with time_out: true",
        )
    for term in terms:
        yield from _ends_at_once(case, term)
    balance = case.facts.balance
    if balance is not None and case.episode_s < _FALLS / balance.pole:
        key, shortest = "env.episode_length_s", at_least(_FALLS / balance.pole)
        yield Finding(
            key,
            f"an episode of {case.episode_s:g} s holds {case.episode_s * balance.pole:.2g} time constants of the fall "
            f"({1 / balance.pole:.3g} s): it may end before anything has gone wrong",
            f"at least {shortest:g} s",
            {"episode_s": case.episode_s, "time_constant_s": 1 / balance.pole},
            ({key: shortest},),
        )


def _ends_at_once(case: Case, term: TermView) -> Iterator[Finding]:
    if term.kind in _LOWEST:
        limit, start = float(term.node["minimum_height"]), case.facts.standing_height
        if limit >= start:
            key, lower = f"{term.path}.minimum_height", below(start, 3)
            yield Finding(
                key,
                f"the robot stands {1e3 * start:.4g} mm high, below the limit of {1e3 * limit:.4g} mm",
                f"at most {lower:g} m",
                {"limit_m": limit, "standing_m": start},
                ({key: lower},),
            )
    if term.kind == "terminations.bad_orientation":
        limit, tilt = float(term.node["limit_angle"]), _drawn_tilt(case)
        if limit >= _UPRIGHT or limit <= tilt:
            key, bounds = f"{term.path}.limit_angle", (above(tilt), below(_UPRIGHT))
            why = "never acts" if limit >= _UPRIGHT else f"is within the tilt of {tilt:.3g} rad that resets draw"
            yield Finding(
                key,
                f"a limit of {limit:.3g} rad {why}",
                f"between {bounds[0]:g} and {bounds[1]:g} rad",
                {"limit_rad": limit, "drawn_rad": tilt},
                tuple({key: bound} for bound in bounds),
            )


def _drawn_tilt(case: Case) -> float:
    """Return the largest tilt that resets draw, rad: of roll and pitch together."""
    ranges = [term.node["pose_range"] for term in case.terms("events", "events.reset_root_state_uniform")]
    return max((math.hypot(largest(r.get("roll")), largest(r.get("pitch"))) for r in ranges), default=0.0)
