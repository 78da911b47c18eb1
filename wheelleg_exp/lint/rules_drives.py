"""Rules about drives: armature, effort, gains versus the time step, and speed versus the fall."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from wheelleg_exp.anatomy.compiled_robot import Drive, Joint
from wheelleg_exp.lint.rule import Case, Finding, at_least, at_most, by_joint, rule
from wheelleg_exp.sim.terrain import combined_friction

_ARMATURE = 10.0  # An armature above ten times the inertia of the links that the joint moves is implausible.
_TRACTION = 10.0  # A wheel's effort limit above ten times the torque at which the wheel slips is implausible.
_PUSH = 0.1  # The wheels must be able to push the robot with at least 10 % of its weight.
_RESERVE = 1.5  # A drive's effort limit must be at least 1.5 times the torque that holds the default pose.
_SAG = 0.1  # The robot's weight may cause a position error of at most 0.1 rad at a leg joint.
_SAMPLES = 5.0  # The time constant of the robot's fall must be at least five control steps.
_IMPLICIT = ("implicit", "implicitfast")
MOST_DAMPING = 2.0  # kd·dt/I of an implicit position drive: with 2.47, a wheel was off the ground in 5 % of the steps


def _groups(case: Case) -> dict[str, dict[str, Joint]]:
    groups: dict[str, dict[str, Joint]] = {}
    for name, joint in case.facts.joints.items():
        if joint.drive is not None:
            groups.setdefault(joint.drive.group, {})[name] = joint
    return groups


def _worst(joints: dict[str, Joint], size: Callable[[Joint, Drive], float]) -> tuple[str, Joint, Drive, float]:
    rows = [(name, joint, joint.drive, size(joint, joint.drive)) for name, joint in joints.items() if joint.drive]
    return max(rows, key=lambda row: row[3])


@rule
def armature_ratio(case: Case) -> Iterator[Finding]:
    """The armature of a joint is far larger than the inertia of the links that the joint moves.

    A rotor behind a gear of ratio n acts at the joint like n² times its inertia. In legged robots, this is about as
    large as the link's inertia, and rarely 10 times larger. A robot with a larger armature cannot be built: it is slow
    and stable, and its policies do not transfer. Source: MuJoCo documentation, XML reference, joint/armature.
    """
    for group, joints in _groups(case).items():
        name, joint, _, ratio = _worst(joints, lambda j, _: j.armature / j.inertia if j.inertia > 0 else 0.0)
        if ratio <= _ARMATURE:
            continue
        figures = {"armature": joint.armature, "inertia": joint.inertia, "ratio": ratio}
        extra, balance = "", case.facts.balance
        if balance is not None and name in case.facts.wheels:
            figures |= {"pitch_inertia": balance.inertia, "pitch_ratio": joint.armature / balance.inertia}
            figures["translation_kg"] = joint.armature / case.facts.wheel_radius**2
            extra = f", {figures['pitch_ratio']:.0f} times the pitch inertia of the parts above the wheels "
            extra += f"({balance.inertia:.3g}), and equivalent to {figures['translation_kg']:.0f} kg of translation"
        yield Finding(
            f"env.robot.actuators.{group}.armature",
            f"{joint.armature:g} kg·m² is {ratio:.0f} times the load of {joint.inertia:.3g} kg·m² on '{name}'{extra}",
            "n² times the rotor's inertia; robot=physical has armatures of geared motors of this size",
            figures,
        )


def wheel_friction(case: Case) -> float:
    """Return the largest friction coefficient of the wheels: of the randomised materials, or else of the model."""
    source, mode = case.env.robot.friction_source, case.env.robot.friction_combine_mode
    ground = float(case.env.scene.terrain[f"{source}_friction"])
    materials = case.terms("events", "events.randomize_rigid_body_material")
    largest = [np.float64(term.node[f"{source}_friction_range"][1]) for term in materials]
    found = [float(combined_friction(own, ground, mode)) for own in largest]
    return max(found, default=case.facts.friction)


@rule
def effort_against_traction(case: Case) -> Iterator[Finding]:
    """The effort limit of a wheel drive is many times the torque at which the wheel slips.

    A wheel slips at the torque friction · load · radius. An effort limit far above the slip torque has no effect, and
    shows that the motor does not fit the robot's weight. Source: Coulomb friction.
    """
    facts = case.facts
    for group, joints in _groups(case).items():
        wheels = {name: joint for name, joint in joints.items() if name in facts.wheels}
        friction = wheel_friction(case)
        slip = friction * facts.wheel_load * facts.wheel_radius
        if not wheels or slip <= 0.0:
            continue
        name, _, drive, _ = _worst(wheels, lambda _, d: d.effort)
        if _TRACTION * slip < drive.effort < math.inf:
            key, motor = f"env.robot.actuators.{group}.effort_limit", at_least(2 * slip)
            yield Finding(
                key,
                f"{drive.effort:g} N·m on '{name}' is {drive.effort / slip:.0f} times the {slip:.3g} N·m at which its "
                f"wheel slips (largest friction {friction:.2f} · load {facts.wheel_load:.3g} N · radius "
                f"{1e3 * facts.wheel_radius:.3g} mm)",
                f"the stall torque of a motor that fits, near {motor:g} N·m",
                {"effort": drive.effort, "slip": slip, "ratio": drive.effort / slip, "friction": friction},
                ({key: motor},),
            )


@rule
def weak_wheels(case: Case) -> Iterator[Finding]:
    """The wheel drives are too weak or too slow to balance a robot on one axle.

    Wheels catch a lean of 0.1 rad only if the wheels accelerate with 0.1 g, which needs a force of a tenth of the
    weight. If the centre of mass is at the height h and the tilt grows as exp(p·t), the wheel rims' speed must exceed
    0.1 rad · h · p. Source: the inverted pendulum on wheels.
    """
    facts = case.facts
    if facts.balance is None:
        return
    needed = _PUSH * facts.wheel_load * facts.wheel_radius
    for group, joints in _groups(case).items():
        efforts = [j.drive.effort for name, j in joints.items() if name in facts.wheels and j.drive is not None]
        weak = min(efforts, default=math.inf)
        if 0.0 < weak < needed:
            key, least = f"env.robot.actuators.{group}.effort_limit", at_least(needed)
            yield Finding(
                key,
                f"{weak:g} N·m on wheels of {1e3 * facts.wheel_radius:.3g} mm that carry {facts.wheel_load:.3g} N "
                f"each push with {weak / (facts.wheel_load * facts.wheel_radius):.2g} of the weight: they cannot catch "
                f"a lean of {_PUSH:g} rad",
                f"at least {least:g} N·m",
                {"effort": weak, "needed": needed},
                ({key: least},),
            )
        speeds = [j.drive.velocity for name, j in joints.items() if name in facts.wheels and j.drive is not None]
        slow, fast = min(speeds, default=math.inf), _PUSH * facts.balance.height * facts.balance.pole
        if slow * facts.wheel_radius < fast:
            key, least = f"env.robot.actuators.{group}.velocity_limit", at_least(fast / facts.wheel_radius)
            message = f"{slow:g} rad/s on wheels of {1e3 * facts.wheel_radius:.3g} mm is "
            message += f"{slow * facts.wheel_radius:.2g} m/s: "
            message += f"a lean of {_PUSH:g} rad grows faster than the wheels can follow"
            hint = f"at least {least:g} rad/s"
            yield Finding(key, message, hint, {"velocity": slow, "needed": fast / facts.wheel_radius}, ({key: least},))


@rule
def effort_against_load(case: Case) -> Iterator[Finding]:
    """A leg drive cannot carry the robot's weight, or sags under the weight.

    At rest, a leg joint carries the weight on the leg's wheel, minus the weight of the links below the joint. The
    effort limit of a leg drive should be 1.5 times the torque that holds the default pose. The drive's stiffness must
    hold the joint within 0.1 rad of its target at an action of 0: the error is gravity's torque over kp, minus the
    action's offset. Couplings and closed loops transfer the loads of joints without a drive to the drives. Source:
    statics, tau = -J^T F.
    """
    for group, joints in _groups(case).items():
        largest = max(abs(joint.hold) for joint in joints.values())
        name, joint, drive, _ = _worst(joints, lambda j, d: abs(j.hold) / d.effort if d.effort else 0.0)
        if 0.0 < drive.effort < _RESERVE * abs(joint.hold):
            key, effort, load = f"env.robot.actuators.{group}.effort_limit", at_least(_RESERVE * largest), joint.hold
            message = f"{drive.effort:g} N·m on '{name}', which carries {abs(load):.3g} N·m at rest"
            hint = f"at least {effort:g} N·m"
            yield Finding(key, message, hint, {"effort": drive.effort, "load": abs(load)}, ({key: effort},))
        # At an action of 0, a joint's position target is its default position plus ``shifts[joint]``, rad.
        shifts: dict[str, float] = {}
        for term in case.terms("actions", "actions.JointPositionAction"):
            if not term.node.get("use_default_offset", True):
                moved = case.joints(term.node)
                offsets = by_joint(term.node.get("offset", 0.0), moved, 0.0)
                shifts |= {name: float(offsets[name]) - joint.default for name, joint in moved.items()}
        sags = {
            other: abs(found.hold / found.drive.stiffness - shifts.get(other, 0.0))
            for other, found in joints.items()
            if found.drive is not None and found.drive.stiffness > 0.0
        }
        name = max(sags, key=sags.__getitem__, default="")
        if name and sags[name] > _SAG and (found_drive := joints[name].drive) is not None:
            key, stiffness, load = f"env.robot.actuators.{group}.stiffness", at_least(largest / _SAG), joints[name].hold
            yield Finding(
                key,
                f"{found_drive.stiffness:g} N·m/rad on '{name}', which carries {abs(load):.3g} N·m at rest: it sags by "
                f"{sags[name]:.2g} rad",
                f"at least {stiffness:g} N·m/rad, or an action with use_default_offset: false and an offset of the "
                "pose plus torque over stiffness",
                {"stiffness": found_drive.stiffness, "load": abs(load), "sag_rad": sags[name]},
                ({key: stiffness},),
            )


@rule
def gains_against_time_step(case: Case) -> Iterator[Finding]:
    """The gains of a drive make the simulation or its contacts unstable with the physics time step of the config.

    An explicit drive computes the torque from the state before the physics step. It is stable for kd·dt/I < 2 and
    kp·dt²/I < 4 - 2·kd·dt/I (time step dt, joint inertia I); a drive with implicit damping, for kp·dt²/I < 4 +
    2·kd·dt/I. I includes the armature, and assumes that all joints can move. Source: Jury's stability criterion for
    MuJoCo's semi-implicit Euler method (documentation, chapter Computation, "Numerical integration"). Above kd·dt/I =
    2, contacts of the links behind a position drive can come and go, because MuJoCo computes contact forces without the
    implicit damping (measured: docs/robots.md).
    """
    dt, integrator = case.physics_dt, case.env.sim.integrator
    for group, joints in _groups(case).items():
        name, joint, drive, _ = _worst(joints, lambda j, d: (d.damping * dt + d.stiffness * dt**2) / j.effective)
        a, b = drive.damping * dt / joint.effective, drive.stiffness * dt**2 / joint.effective
        explicit = drive.explicit or integrator not in _IMPLICIT
        if math.isnan(b):  # A drive that is a neural network has the gains NaN.
            continue
        stable = (a < 2.0 and b < 4.0 - 2.0 * a) if explicit else b < 4.0 + 2.0 * a
        # The time step of a robot file's project will follow from its drives.
        if stable and (explicit or not case.of_task or drive.stiffness == 0.0 or a <= MOST_DAMPING):
            continue
        criterion = "kd·dt/I < 2 and kp·dt²/I < 4 - 2·kd·dt/I" if explicit else "kp·dt²/I < 4 + 2·kd·dt/I"
        key = "damping" if stable or (explicit and a >= 2.0) else "stiffness"
        message = f"on '{name}' (I = {joint.effective:.3g} kg·m², dt = {dt:.4g} s) kd·dt/I is {a:.3g} and kp·dt²/I is "
        fault = f"unstable, {'explicit' if explicit else 'implicit'} drives need {criterion}"
        message += f"{b:.3g}: {f'contacts come and go, kd·dt/I must be at most {MOST_DAMPING}' if stable else fault}"
        hint = "an implicit drive, a finer env.sim.dt, more armature or smaller gains"
        figures = {"a": a, "b": b, "inertia": joint.effective, "dt": dt}
        yield Finding(f"env.robot.actuators.{group}.{key}", message, hint, figures)


@rule
def control_rate(case: Case) -> Iterator[Finding]:
    """The control rate is too low to balance the robot.

    A sampled controller acts one and a half control steps late on average. At least five control steps should fit into
    the time in which a falling robot's tilt grows by the factor e. Source: Åström, "Limitations on control system
    performance", 2000, on delay with an unstable pole.
    """
    balance = case.facts.balance
    if balance is None:
        return
    samples = 1.0 / (balance.pole * case.step_dt)
    if samples < _SAMPLES:
        longest = at_most(1.0 / (_SAMPLES * balance.pole))
        steps = math.floor(longest / case.physics_dt * (1 + 1e-9))
        change = {"env.decimation": steps} if steps else {"env.decimation": 1, "env.sim.dt": longest}
        yield Finding(
            "env.decimation",
            f"the robot falls with a time constant of {1 / balance.pole:.3g} s, which holds {samples:.2g} control "
            f"steps of {case.step_dt:.3g} s",
            f"control steps of at most {longest:g} s: " + ", ".join(f"{key}={v:g}" for key, v in change.items()),
            {"time_constant_s": 1 / balance.pole, "samples": samples},
            (change,),
        )


@rule
def drive_bandwidth(case: Case) -> Iterator[Finding]:
    """The bandwidth of a drive is too low to balance the robot.

    The bandwidth of a position drive is sqrt(kp/I), and the bandwidth of a velocity drive is kd/I. The bandwidth must
    be at least the rate of the robot's fall for a leg drive, and twice this rate for a wheel drive. Source: the
    closed-loop poles of a PD drive on a free inertia.
    """
    balance = case.facts.balance
    if balance is None:
        return
    for group, joints in _groups(case).items():
        name, joint, drive, rate = _worst(
            joints,
            lambda j, d: -(math.sqrt(d.stiffness / j.effective) if d.stiffness > 0.0 else d.damping / j.effective),
        )
        bandwidth = -rate
        needed = balance.pole * (2.0 if drive.stiffness == 0.0 else 1.0)
        if not 0.0 < bandwidth < needed:
            continue
        ratio = drive.damping / (2 * math.sqrt(drive.stiffness * joint.effective)) if drive.stiffness > 0.0 else 0.0
        damped = f" (damping ratio {ratio:.2f})" if drive.stiffness else ""
        inertia = max(joint.effective for joint in joints.values())
        gain = at_least(inertia * needed**2 if drive.stiffness else inertia * needed)
        name_of, unit = ("stiffness", "N·m/rad") if drive.stiffness else ("damping", "N·m·s/rad")
        key = f"env.robot.actuators.{group}.{name_of}"
        yield Finding(
            key,
            f"'{name}' follows up to {bandwidth:.3g} rad/s{damped}, and the robot falls at {balance.pole:.3g} rad/s",
            f"at least {needed:.3g} rad/s: less armature, or a {name_of} of at least {gain:g} {unit}",
            {"bandwidth": bandwidth, "pole": balance.pole, "damping_ratio": ratio},
            ({key: gain},),
        )
