"""What the networks see: bounds, sizes and noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from wheelleg_exp.lint.case import Case, TermView, kind_of, largest
from wheelleg_exp.lint.findings import Finding, at_most, below, rule
from wheelleg_exp.terms.binding import TARGET

_ANGLES = ("observations.joint_pos", "observations.joint_pos_rel")
# Of the numbers that a network sees: too small to move a unit, or so large that it drowns the others.
_SMALLEST, _LARGEST = 0.01, 10.0
_LOUD = 0.5  # noise, as a share of the signal's size
# What says how large a noise is, with its defaults: half-widths, a standard deviation.
_NOISES = {"noise.UniformNoise": {"n_min": -1.0, "n_max": 1.0}, "noise.GaussianNoise": {"std": 1.0}}


@rule
def unbounded_observation(case: Case) -> Iterator[Finding]:
    """An observed angle that grows without end, as that of a wheel does.

    A joint without limits that turns at its top speed for one episode gives the largest angle that training sees;
    whatever runs longer than an episode leaves that range. Source: arithmetic; several public wheel-legged
    projects leave wheel angles out of the observation for it.
    """
    for term in case.terms("observations", *_ANGLES):
        endless = {name: joint for name, joint in case.joints(term.node).items() if not joint.limited}
        if not endless or term.node.get("clip") is not None:
            continue
        speed = max((joint.drive.velocity for joint in endless.values() if joint.drive), default=0.0)
        angle = speed * case.episode_s
        yield Finding(
            term.path,
            f"the angle of {', '.join(endless)} has no bound: {angle:.0f} rad within an episode at the drive's "
            f"{speed:g} rad/s, and more in anything longer",
            "asset_cfg without these joints, joint_pos_sin_cos for them, or a clip",
            {"largest_rad": angle, "speed_rad_s": speed, "episode_s": case.episode_s},
        )


@rule
def observation_scale(case: Case) -> Iterator[Finding]:
    """An observation that reaches the network much larger or smaller than 1.

    Networks start with weights for inputs of size 1. The largest value of each component, from the robot's limits
    and the config's ranges, is held against 0.01 and 10; an actor or critic that normalises its input is exempt.
    Source: Andrychowicz et al., "What matters in on-policy reinforcement learning?", 2021, on input normalisation.
    """
    for term in case.terms("observations"):
        if _is_normalised(case, term.path.split(".")[2]):
            continue
        size, scale = signal_size(case, term), largest_scale(term.node.get("scale"))
        if size is None or size == 0.0 or _SMALLEST <= size * scale <= _LARGEST:
            continue
        fitting = at_most(1.0 / size)
        yield Finding(
            term.path,
            f"values of up to {size:.3g} times a scale of {scale:g} reach the network as {size * scale:.3g}",
            f"a scale near {fitting:g}, so that the largest value is near 1",
            {"largest": size, "scale": scale, "seen": size * scale},
            ({f"{term.path}.scale": fitting},),
        )


def largest_scale(scale: Any) -> float:
    """Return the largest factor of a term's ``scale``; 1 without one."""
    if scale is None:
        return 1.0
    return largest(scale) if isinstance(scale, list) else abs(float(scale))


def _is_normalised(case: Case, group: str) -> bool:
    """Return whether every network that gets a group normalises its input."""
    networks = [name for name, groups in case.agent["obs_groups"].items() if group in groups]
    return bool(networks) and all(case.agent.get(n, {}).get("obs_normalization", False) for n in networks)


def signal_size(case: Case, term: TermView) -> float | None:
    """Return the largest size of an observation's components before scale, in its own unit; None when unknown."""
    drives = [joint.drive for joint in case.joints(term.node).values() if joint.drive is not None]
    if term.kind in ("observations.projected_gravity", "observations.joint_pos_sin_cos", "observations.last_action"):
        return 1.0
    if term.kind in _ANGLES:
        limited = [joint for joint in case.joints(term.node).values() if joint.limited]
        return max((max(j.high - j.default, j.default - j.low) for j in limited), default=None)
    if term.kind in ("observations.joint_vel", "observations.joint_vel_rel"):
        return max((drive.velocity for drive in drives), default=None)
    if term.kind == "observations.joint_effort_commanded":
        return max((drive.effort for drive in drives), default=None)
    if term.kind in ("observations.base_lin_vel", "observations.root_link_lin_vel"):
        return case.facts.top_speed or None
    if term.kind == "observations.base_ang_vel":  # falling through one radian
        return case.facts.balance.pole if case.facts.balance is not None else None
    if term.kind == "observations.generated_commands":
        return _command_size(case, str(term.node["command_name"]))
    return None


def _command_size(case: Case, name: str) -> float | None:
    ranges = case.env["commands"].get(name, {}).get("ranges")
    return max((largest(pair) for pair in ranges.values()), default=None) if isinstance(ranges, Mapping) else None


@rule
def noise_against_signal(case: Case) -> Iterator[Finding]:
    """Observation noise that never acts, or that hides what it is added to.

    Noise acts only in groups with ``enable_corruption``; noise of half the signal's largest size leaves little of
    it. Source: Isaac Lab 2.3.2, ``isaaclab/managers/observation_manager.py``, on corruption.
    """
    for name, group in case.env["observations"].items():
        path, corrupt = f"env.observations.{name}", bool(group.get("enable_corruption", False))
        terms = [t for t in case.terms("observations") if t.path.startswith(f"{path}.terms.")]
        noisy = [term for term in terms if term.node.get("noise") is not None]
        if corrupt and not noisy:
            yield Finding(
                f"{path}.enable_corruption",
                f"none of the {len(terms)} terms has noise: nothing is corrupted",
                "a noise for the terms that a sensor measures, or enable_corruption: false",
                {"terms": len(terms)},
            )
        for term in noisy:
            yield from _noise_findings(case, term, corrupt)


def _noise_findings(case: Case, term: TermView, corrupt: bool) -> Iterator[Finding]:
    if not corrupt:
        group = term.path.split(".terms.")[0]
        yield Finding(
            f"{term.path}.noise",
            "the noise never acts, because its group has enable_corruption: false",
            f"{group}.enable_corruption=true, or no noise",
        )
        return
    sizes = _noise_sizes(term.node["noise"], term.path)
    size, noise = signal_size(case, term), max(map(abs, sizes.values()), default=0.0)
    if size and noise >= _LOUD * size:
        quiet = below(_LOUD * size)
        yield Finding(
            f"{term.path}.noise",
            f"noise of {noise:.3g} on a signal of at most {size:.3g}: {100 * noise / size:.0f} % of it",
            f"noise of at most {quiet:g}",
            {"noise": noise, "signal": size, "ratio": noise / size},
            ({f"{term.path}.noise.{name}": math.copysign(quiet, value) for name, value in sizes.items()},),
        )


def _noise_sizes(noise: Any, path: str) -> dict[str, float]:
    """Return the parameters that say how large an added noise is; nothing when that is not known."""
    kind = kind_of(str(noise[TARGET]), f"{path}.noise") if isinstance(noise, Mapping) and TARGET in noise else ""
    if kind not in _NOISES or noise.get("operation", "add") != "add":
        return {}
    return {name: float(noise.get(name, default)) for name, default in _NOISES[kind].items()}
