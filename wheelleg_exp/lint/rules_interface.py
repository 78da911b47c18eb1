"""Rules about the policy's interface: scale, bounds, and noise of observations; actions and commands versus drives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import median

from wheelleg_exp.anatomy.compiled_robot import Drive, Joint
from wheelleg_exp.lint.rule import Case, Finding, TermView, at_least, at_most, below, by_joint, kind_of, largest, rule
from wheelleg_exp.sim.names import values_by_name
from wheelleg_exp.terms.term_binding import TARGET

_POSITION = ("actions.JointPositionAction", "actions.RelativeJointPositionAction")
_ABSOLUTE = "actions.JointPositionAction"
_VELOCITY = ("actions.JointVelocityAction",)
_TINY = 0.01  # An action of 1 should move a joint by at least 1 % of the joint's range.


@rule
def action_scale(case: Case) -> Iterator[Finding]:
    """The effect of an action of 1 is too large, too small, or zero.

    At the start of training, actions are about ±1. An action of 1 should respect the joint's limits and the drive's
    torque and speed, and move the joint by at least a hundredth of its range. A position target needs stiffness, and a
    speed target needs damping. Source: the drive's law, tau = kp (q* - q) + kd (qd* - qd).
    """
    for term in case.terms("actions", *_POSITION, *_VELOCITY):
        joints = case.joints(term.node)
        scales = by_joint(term.node.get("scale", 1.0), joints, 1.0)
        for name, joint in joints.items():
            if joint.drive is None:
                continue
            unit = abs(float(scales[name]))
            reason = _reason(term, joint, joint.drive, unit)
            if reason is not None:
                key, (message, hint, figures) = f"{term.path}.scale", reason
                scale = None if hint else _fitting_scale(term, joints.values(), unit)
                hint = hint or ("a default pose well inside the limits" if scale is None else f"a scale near {scale:g}")
                advice = () if scale is None else ({key: scale},)
                yield Finding(key, f"'{name}': {message}", hint, figures, advice)
                break  # Report only one joint of each action term.


def _reason(term: TermView, joint: Joint, drive: Drive, unit: float) -> tuple[str, str, dict[str, float]] | None:
    """If an action scale is bad, return a message, a hint (empty if a new scale helps), and numbers; otherwise None."""
    if term.kind in _VELOCITY:
        if drive.damping == 0.0:
            return "a speed target needs the drive's damping, which is 0", "a damping above 0", {"damping": 0.0}
        if unit > drive.velocity:
            text = f"one unit is {unit:g} rad/s, beyond the drive's {drive.velocity:g} rad/s"
            return text, "", {"unit": unit, "limit": drive.velocity}
        return None
    if drive.stiffness == 0.0:
        return "a position target needs the drive's stiffness, which is 0", "a stiffness above 0", {"stiffness": 0.0}
    if unit * drive.stiffness > drive.effort:
        text = f"one unit is {unit:g} rad or {unit * drive.stiffness:.3g} N·m, beyond the drive's {drive.effort:g} N·m"
        return text, "", {"torque": unit * drive.stiffness}
    if term.kind != _ABSOLUTE or not joint.limited:
        return None
    room, span = _room(joint), joint.high - joint.low
    if unit > room:
        text = f"one unit is {unit:g} rad, and the nearest limit is {room:.3g} rad from the default"
        return text, "", {"unit": unit, "room": room}
    if unit < _TINY * span:
        return f"one unit is {unit:g} rad of a range of {span:.3g} rad", "", {"unit": unit, "span": span}
    return None


def _room(joint: Joint) -> float:
    return min(joint.high - joint.default, joint.default - joint.low)


def _fitting_scale(term: TermView, joints: Iterable[Joint], unit: float) -> float | None:
    """Return an action scale near the current scale ``unit`` that suits all joints of a term; None if there is none."""
    smallest, largest_one = 0.0, math.inf
    for joint in joints:
        if joint.drive is None:
            continue
        if term.kind in _VELOCITY:
            largest_one = min(largest_one, joint.drive.velocity)
            continue
        if joint.drive.stiffness > 0.0:
            largest_one = min(largest_one, joint.drive.effort / joint.drive.stiffness)
        if term.kind == _ABSOLUTE and joint.limited:
            largest_one = min(largest_one, _room(joint))
            smallest = max(smallest, _TINY * (joint.high - joint.low))
    fitting = at_least(smallest) if unit < smallest else at_most(largest_one)
    return fitting if fitting > 0.0 and smallest <= fitting <= largest_one else None


@rule
def action_clip_never_acts(case: Case) -> Iterator[Finding]:
    """The bounds ``clip`` of an action have no effect, because the joint or the drive has narrower limits.

    The parameter ``clip`` of an action bounds the joint's target in rad or rad/s, not the raw action. Source: Isaac Lab
    2.3.2, ``isaaclab/envs/mdp/actions/joint_actions.py``: scale, offset, then clip.
    """
    for term in case.terms("actions", _ABSOLUTE, *_VELOCITY):
        joints = case.joints(term.node)
        clips = values_by_name(term.node.get("clip") or {}, list(joints), None, key="clip", what="joint")
        for name, clip in zip(joints, clips, strict=True):
            joint, unit = joints[name], "rad"
            low, high = joint.low, joint.high
            if term.kind in _VELOCITY:
                unit, high = "rad/s", joint.drive.velocity if joint.drive is not None else math.inf
                low = -high
            if isinstance(clip, Sequence) and clip[0] <= low and clip[1] >= high and math.isfinite(low):
                message = f"targets are clipped to [{clip[0]:g}, {clip[1]:g}] {unit}, and '{name}' reaches "
                message += f"[{low:.3g}, {high:.3g}] {unit}: the clip has no effect"
                hint = "bounds inside the joint's limits, or no clip; agent.clip_actions bounds raw actions"
                figures = {"clip_low": float(clip[0]), "clip_high": float(clip[1]), "low": low, "high": high}
                yield Finding(f"{term.path}.clip", message, hint, figures)
                break  # Report only one joint of each action term.


@rule
def command_reach(case: Case) -> Iterator[Finding]:
    """The robot's wheels cannot produce a commanded velocity.

    The top speed is the speed limit of the wheel drives times the wheel radius; the top yaw rate is twice this speed
    over the track width. Parallel axles allow no sideways motion. Source: kinematics of a differential drive.
    """
    facts = case.facts
    if not facts.wheels or facts.top_speed == 0.0:
        return
    top = facts.top_speed
    limits = {"lin_vel_x": top, "lin_vel_y": 0.0, "ang_vel_z": 2 * top / facts.track if facts.track else math.inf}
    for term in case.terms("commands", "commands.UniformVelocityCommand"):
        for axis, limit in limits.items():
            size, unit = largest(term.node["ranges"].get(axis)), "rad/s" if axis == "ang_vel_z" else "m/s"
            if size > limit:
                key, most = f"{term.path}.ranges.{axis}", at_most(limit)
                reach = f"the wheels reach {limit:.3g} {unit}" if limit else "wheels cannot move sideways"
                message = f"up to {size:g} {unit} is commanded, and {reach}"
                hint = f"a range within ±{most:g}"
                yield Finding(key, message, hint, {"command": size, "limit": limit}, ({key: [-most, most]},))


_ANGLES = ("observations.joint_pos", "observations.joint_pos_rel")
_SMALLEST, _LARGEST = 0.01, 10.0  # The size of a policy's inputs should be between 0.01 and 10.
_LOUD = 0.5  # An observation's noise should be below 50 % of the observation's largest value.
# ``_NOISES`` maps each type of observation noise to the parameters for the noise's size, with their default values.
_NOISES = {"noise.UniformNoise": {"n_min": -1.0, "n_max": 1.0}, "noise.GaussianNoise": {"std": 1.0}}


@rule
def unbounded_observation(case: Case) -> Iterator[Finding]:
    """The policy observes an unbounded angle, such as the angle of a wheel.

    In training, an unlimited joint turns at most at its top speed for one episode; longer runs lead to larger angles.
    Source: arithmetic; several public wheel-legged projects omit the unbounded angles of wheels.
    """
    for term in case.terms("observations", *_ANGLES):
        endless = {name: joint for name, joint in case.joints(term.node).items() if not joint.limited}
        if not endless or term.node.get("clip") is not None:
            continue
        speed = max((joint.drive.velocity for joint in endless.values() if joint.drive), default=0.0)
        angle = speed * case.episode_s
        message = f"the angle of {', '.join(endless)} has no bound: {angle:.0f} rad within an episode at the drive's "
        message += f"{speed:g} rad/s, and more in a longer run"
        hint = "asset_cfg without these joints, joint_pos_sin_cos for them, or a clip"
        figures = {"largest_rad": angle, "speed_rad_s": speed, "episode_s": case.episode_s}
        yield Finding(term.path, message, hint, figures)


@rule
def observation_scale(case: Case) -> Iterator[Finding]:
    """The size of an observation at the network's input is much larger or smaller than 1, or than its neighbours.

    Networks are initialised for inputs of about 1. The largest value of an observation, computed from the robot's
    limits and the config, should be between 0.01 and 10, and above 1 % of its group's median. Networks with normalised
    inputs are not checked. Source: Andrychowicz et al., "What matters in on-policy reinforcement learning?", 2021.
    """
    inputs = {term.path: (signal_size(case, term) or 0.0) * _scale(term) for term in case.terms("observations")}
    for term in case.terms("observations"):
        group = term.path.split(".")[2]
        others = [i for path, i in inputs.items() if i and path.split(".")[2] == group and path != term.path]
        networks = [name for name, groups in case.agent.obs_groups.items() if group in groups]
        if networks and all(case.agent.networks.get(n, {}).get("obs_normalization", False) for n in networks):
            continue
        size, scale, usual = signal_size(case, term), _scale(term), median(others or [1.0])
        if not size or _SMALLEST * max(1.0, usual) < size * scale <= _LARGEST:
            continue
        fitting = at_most(1.0 / size)
        message = f"values of up to {size:.3g} times a scale of {scale:g} reach the network as {size * scale:.3g}"
        message += f", the group's other terms as {usual:.3g}" if others else ""
        hint = f"a scale near {fitting:g}, so that the largest value is near 1"
        figures = {"largest": size, "scale": scale, "seen": size * scale}
        yield Finding(term.path, message, hint, figures, ({f"{term.path}.scale": fitting},))


def _scale(term: TermView) -> float:
    given = term.node.get("scale")
    return largest(given) if isinstance(given, list) else 1.0 if given is None else abs(float(given))


def signal_size(case: Case, term: TermView) -> float | None:
    """Return the largest absolute value of an observation's components before scaling; None if unknown."""
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
        ranges = case.env.commands.get(str(term.node["command_name"]), {}).get("ranges")
        return max((largest(pair) for pair in ranges.values()), default=None) if isinstance(ranges, Mapping) else None
    return None


@rule
def noise_against_signal(case: Case) -> Iterator[Finding]:
    """The noise of an observation has no effect, or hides the signal.

    Noise acts only in groups with ``enable_corruption``. Noise half as large as the largest signal hides most of it.
    Source: Isaac Lab 2.3.2, ``isaaclab/managers/observation_manager.py``, ``enable_corruption``.
    """
    for name, group in case.env.observations.items():
        path, corrupt = f"env.observations.{name}", group.enable_corruption
        terms = [t for t in case.terms("observations") if t.path.startswith(f"{path}.terms.")]
        noisy = [term for term in terms if term.node.get("noise") is not None]
        if corrupt and not noisy:
            message = f"none of the {len(terms)} terms has noise, so enable_corruption has no effect"
            hint = "a noise for the terms that a sensor measures, or enable_corruption: false"
            yield Finding(f"{path}.enable_corruption", message, hint, {"terms": len(terms)})
        for term in noisy:
            key, node, sizes = f"{term.path}.noise", term.node["noise"], dict[str, float]()
            if not corrupt:
                message = "the noise has no effect, because its group has enable_corruption: false"
                yield Finding(key, message, f"{path}.enable_corruption=true, or no noise")
                continue
            kind = kind_of(str(node[TARGET]), key) if isinstance(node, Mapping) and TARGET in node else ""
            if kind in _NOISES and node.get("operation", "add") == "add":
                sizes = {name: float(node.get(name, default)) for name, default in _NOISES[kind].items()}
            size, noise = signal_size(case, term), max(map(abs, sizes.values()), default=0.0)
            if size and noise >= _LOUD * size:
                quiet = below(_LOUD * size)
                message = f"noise of {noise:.3g} on a signal of at most {size:.3g}: {100 * noise / size:.0f} % of it"
                advice = {f"{key}.{name}": math.copysign(quiet, value) for name, value in sizes.items()}
                figures = {"noise": noise, "signal": size, "ratio": noise / size}
                yield Finding(key, message, f"noise of at most {quiet:g}", figures, (advice,))
