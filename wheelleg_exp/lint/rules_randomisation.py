"""Randomisation that does nothing, or not what it says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.findings import Finding, below, rule

_SCALES = ("events.reset_joints_by_scale",)
_CUMULATIVE = ("events.randomize_rigid_body_com_cumulative",)
_MATERIAL = ("events.randomize_rigid_body_material",)
_REPEATED = ("reset", "interval")
_FIXED = ("resampling_time_range", "restitution_range")  # a period may well be fixed, and nothing bounces


@rule
def noop_joint_reset(case: Case) -> Iterator[Finding]:
    """A reset by scale that multiplies zeros.

    The event sets a joint to its default times a drawn factor: where the default is 0, it is 0 whatever is drawn.
    Source: Isaac Lab 2.3.2, ``isaaclab/envs/mdp/events.py``, ``reset_joints_by_scale``.
    """
    for term in case.terms("events", *_SCALES):
        joints = case.joints(term.node)
        for name, zeros in (
            ("position_range", [j for j, facts in joints.items() if facts.default == 0.0]),
            ("velocity_range", [j for j, facts in joints.items() if facts.default_velocity == 0.0]),
        ):
            low, high = term.node[name]
            if low == high or not zeros:
                continue
            what = name.removesuffix("_range")
            which = "every joint" if len(zeros) == len(joints) else ", ".join(zeros)
            yield Finding(
                f"{term.path}.{name}",
                f"the factor U({low:g}, {high:g}) multiplies a default {what} of 0 on {which}: nothing is drawn",
                "reset_joints_by_offset adds the drawn value instead",
                {"low": low, "high": high, "joints": len(zeros)},
            )


@rule
def zero_width_range(case: Case) -> Iterator[Finding]:
    """A range whose ends are equal, so that every draw is the same.

    Of ranges by axis, at least one axis must have a width. A command that never changes makes its observation a
    constant, which no policy learns from. Source: arithmetic.
    """
    for term in (*case.terms("events"), *case.terms("commands")):
        for name, value in term.node.items():
            if name in _FIXED or not _is_range(str(name), value) or _has_width(value):
                continue
            shown = next(iter(value.values())) if isinstance(value, Mapping) else value
            yield Finding(
                f"{term.path}.{name}",
                f"every draw is {float(shown[0]):g}: the range has no width",
                "give it a width, or take the draw out",
                {"low": float(shown[0]), "high": float(shown[1])},
            )


def _is_range(name: str, value: Any) -> bool:
    if name == "ranges" or (name.endswith("_range") and isinstance(value, Mapping)):
        return bool(_pairs(value))
    ranged = name.endswith("_range") or name == "mass_distribution_params"
    return ranged and isinstance(value, list) and len(value) == 2


def _pairs(value: Mapping[str, Any]) -> list[Any]:
    return [pair for pair in value.values() if pair is not None]


def _has_width(value: Any) -> bool:
    pairs = _pairs(value) if isinstance(value, Mapping) else [value]
    return any(pair[0] != pair[1] for pair in pairs)


@rule
def event_never_fires(case: Case) -> Iterator[Finding]:
    """An interval event that no episode lives long enough to see.

    The timer of each environment is drawn anew at every reset: a shortest interval of at least an episode never
    runs out. Source: Isaac Lab 2.3.2, ``isaaclab/managers/event_manager.py``, ``reset``.
    """
    for term in case.terms("events"):
        if term.node.get("mode") != "interval" or term.node.get("is_global_time", False):
            continue
        shortest = float(term.node["interval_range_s"][0])
        if shortest >= case.episode_s:
            key, longest = f"{term.path}.interval_range_s", float(term.node["interval_range_s"][1])
            yield Finding(
                key,
                f"the shortest interval is {shortest:g} s and an episode lasts {case.episode_s:g} s at most; timers "
                "are redrawn at each reset, so the event never happens",
                f"an interval below {case.episode_s:g} s, longer episodes, or is_global_time",
                {"shortest_s": shortest, "episode_s": case.episode_s},
                ({key: [below(case.episode_s), longest]}, {f"{term.path}.is_global_time": True}),
            )


@rule
def cumulative_randomisation(case: Case) -> Iterator[Finding]:
    """A centre of mass that walks away, because each draw adds to the last one.

    After n draws of half-width d the offset has a spread of d sqrt(n / 3), the deviation of a sum of uniform
    draws. Source: Isaac Lab 2.3.2, ``isaaclab/envs/mdp/events.py``, ``randomize_rigid_body_com``.
    """
    for term in case.terms("events", *_CUMULATIVE):
        if term.node.get("mode") not in _REPEATED:
            continue
        width = max((abs(float(v)) for pair in term.node["com_range"].values() for v in pair), default=0.0)
        spread = width * (100 / 3) ** 0.5
        yield Finding(
            f"{term.path}.mode",
            f"offsets of up to {1e3 * width:.3g} mm add up at each {term.node['mode']}: after 100 of them the spread "
            f"is {1e3 * spread:.3g} mm",
            "mode: startup draws once",
            {"width_m": width, "spread_after_100_m": spread},
            ({f"{term.path}.mode": "startup"},),
        )


@rule
def noop_restitution(case: Case) -> Iterator[Finding]:
    """Restitution that is drawn and has no effect.

    MuJoCo's soft contacts have no coefficient of restitution: the drawn value acts on nothing. Source: MuJoCo
    documentation, Computation, "Contact".
    """
    for term in case.terms("events", *_MATERIAL):
        low, high = term.node["restitution_range"]
        if low != high:
            key = f"{term.path}.restitution_range"
            yield Finding(
                key,
                f"restitution U({low:g}, {high:g}) is drawn, but MuJoCo has no coefficient for it to act on",
                "[0.0, 0.0], or vary the contact softness of the model",
                {"low": low, "high": high},
                ({key: [0.0, 0.0]},),
            )
