"""Pushes and wrenches against what the robot can take."""

from __future__ import annotations

import math
from collections.abc import Iterator

from wheelleg_exp.lint.case import Case, largest
from wheelleg_exp.lint.findings import Finding, at_least, at_most, rule
from wheelleg_exp.lint.robot_facts import Balance
from wheelleg_exp.lint.rules_drives import wheel_friction

_MARGIN = 1.2  # the pendulum's figure is on the safe side of what a good policy catches
_WEAK = 0.2  # share of the largest push that still tells policies apart
_LEAN = math.radians(10.0)
_PUSHES = ("events.push_by_adding_velocity", "events.set_root_velocity")


def largest_push(case: Case, balance: Balance) -> float:
    """Return the speed that the wheels can still catch, m/s: a/w.

    a is what friction or the drive lets the wheels accelerate with, w = sqrt(m g h / I): the capture point lies
    v/w ahead, and the wheels must get there with less than a/w². Source: Pratt et al., "Capture point", 2006.
    """
    facts = case.facts
    drives = [(joint.drive, joint) for name in facts.wheels if (joint := facts.joints[name]).drive is not None]
    spin = min((drive.effort / joint.effective for drive, joint in drives if drive is not None), default=math.inf)
    return min(wheel_friction(case) * facts.gravity, spin * facts.wheel_radius) / balance.pendulum


@rule
def push_size(case: Case) -> Iterator[Finding]:
    """A push that the robot cannot take, or that every policy takes.

    The largest push that wheels can catch is a/w: their acceleration, limited by friction or by the drive, over the
    rate of the pendulum. Well beyond it every policy falls; below a fifth of it no policy is told from another.
    Pushes to the side are left out where they are drawn in the robot's own axes: wheels catch nothing sideways, and
    their track holds what comes from there. Those along the world's y axis meet a robot that has turned from the front.
    Source: Pratt et al., "Capture point: a step toward humanoid push recovery", 2006.
    """
    balance = case.facts.balance
    if balance is None:
        return
    limit = largest_push(case, balance)
    for term in case.terms("events", *_PUSHES):
        ranges, axes = term.node["velocity_range"], "x" if term.node.get("frame") == "yaw" else "xy"
        pushes = {axis: largest(ranges.get(axis)) for axis in axes}
        push = max(pushes.values())
        if push > _MARGIN * limit or 0.0 < push < _WEAK * limit:
            much = push > limit
            weak, strong = at_least(_WEAK * limit), at_most(limit)
            verdict = "more than it can take" if much else f"{100 * push / limit:.0f} % of it: it tests nothing"
            yield Finding(
                f"{term.path}.velocity_range",
                f"pushes of up to {push:.2g} m/s, and the wheels catch {limit:.2g} m/s: {verdict}",
                f"between {weak:g} and {strong:g} m/s",
                {"push": push, "limit": limit, "ratio": push / limit},
                tuple(
                    {
                        f"{term.path}.velocity_range.{axis}": [-size, size]
                        for axis, found in pushes.items()
                        if found == push or found > limit
                    }
                    for size in (weak, strong)
                ),
            )


@rule
def wrench_size(case: Case) -> Iterator[Finding]:
    """A lasting force or torque that leans the robot over.

    A force F at the body leans a balancing robot by atan(F / weight), a torque T by asin(T / (m g h)), for the whole
    episode. Source: statics of the inverted pendulum.
    """
    balance = case.facts.balance
    if balance is None:
        return
    for term in case.terms("events", "events.set_permanent_body_wrench"):
        force, torque = largest(term.node["force_range"]), largest(term.node["torque_range"])
        by_force = math.atan(force / case.facts.weight)
        moment = balance.mass * case.facts.gravity * balance.height
        by_torque = math.asin(min(1.0, torque / moment))
        if by_force + by_torque > _LEAN:
            most = at_most(case.facts.weight * math.tan(_LEAN / 2)), at_most(moment * math.sin(_LEAN / 2))
            yield Finding(
                term.path,
                f"{force:g} N leans the robot by {math.degrees(by_force):.2g}° and {torque:g} N·m by "
                f"{math.degrees(by_torque):.2g}°, for the whole episode",
                f"forces within ±{most[0]:g} N and torques within ±{most[1]:g} N·m",
                {"force_lean_rad": by_force, "torque_lean_rad": by_torque},
                ({f"{term.path}.{n}_range": [-m, m] for n, m in zip(("force", "torque"), most, strict=True)},),
            )
