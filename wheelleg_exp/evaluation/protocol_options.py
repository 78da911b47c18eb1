"""Options of a protocol: its tests, their number of episodes, and their length; ``configs/protocol/``."""

from __future__ import annotations

import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from wheelleg_exp.constraints import (
    Broken,
    Count,
    Length,
    NonNegative,
    NotEmpty,
    Parameters,
    Positive,
    Seed,
    Share,
    relation,
)
from wheelleg_exp.errors import nearest_name
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.sim.options import EnvOptions
from wheelleg_exp.terms.config_values import value_errors

Ground = Literal["flat", "own"]
Speeds = Annotated[list[float], NotEmpty()]


def _some_step(lin_vel_x: list[float], ang_vel_z: list[float]) -> Iterator[Broken]:
    if not lin_vel_x and not ang_vel_z:
        yield Broken("lin_vel_x", "the step test has no speed", "a speed here or in ang_vel_z")


def _something_counts(**protocol: Any) -> Iterator[Broken]:
    tests, settle = ("stand", "walk", "height", "terrain", "bump", "strip", "robust"), protocol["settle_s"]
    lengths = {f"{test}.horizon_s": protocol[test]["horizon_s"] for test in tests if protocol[test] is not None}
    if (steps := protocol["steps"]) is not None:
        lengths["steps.drive_s"] = steps["stand_s"] + 3 * steps["drive_s"]
    for test in ("push", "get_up", "jump"):
        if (options := protocol[test]) is not None:
            lengths[f"{test}.after_s"] = options["at_s"] + options["after_s"]
            if options["recovered_s"] > options["after_s"]:
                expected = f"at most {options['after_s']:g}, the value of after_s"
                yield Broken(f"{test}.recovered_s", "recovered_s is longer than the time after at_s", expected)
    if not lengths:
        expected = "one of stand, walk, height, steps, push, jump, get_up, terrain, bump, strip, robust, not null"
        yield Broken("", "the protocol has no test", expected)
    for key, seconds in lengths.items():
        if seconds <= settle:
            message = f"an episode of {seconds:g} s ends before its steps count"
            yield Broken(key, message, f"episodes longer than protocol.settle_s, {settle:g} s")


@dataclass(frozen=True)
class Stand:
    """``protocol.stand``: standing with a zero command.

    Attributes:
        episodes: number of episodes.
        horizon_s: length of each episode, s.
        survival_s: moments at which survival is measured, s; moments after the horizon are skipped.
    """

    episodes: Count
    horizon_s: Positive
    survival_s: list[Positive]


@dataclass(frozen=True)
class Walk:
    """``protocol.walk``: every pair of a forward speed and a yaw rate, constant over the episode.

    Attributes:
        episodes: number of episodes per cell of the grid.
        horizon_s: length of each episode, s.
        lin_vel_x: forward speeds, m/s.
        ang_vel_z: yaw rates, rad/s.
        steady_s: start of the steady drive, from which the mean velocity is taken, s.
        band: largest steady error as a share of the command.
        std_lin_vel_x: std of the skill score's exp(-e²/std²), m/s.
        std_ang_vel_z: the same for the yaw rate, rad/s.
    """

    episodes: Count
    horizon_s: Positive
    lin_vel_x: Speeds
    ang_vel_z: Speeds
    steady_s: NonNegative
    band: Share
    std_lin_vel_x: Positive
    std_ang_vel_z: Positive


@relation(_some_step)
@dataclass(frozen=True)
class Steps:
    """``protocol.steps``: stand, drive, reverse, stop, on one axis at a time.

    Attributes:
        episodes: number of episodes per cell.
        stand_s: duration of standing at the start, s.
        drive_s: duration of each of the three commands, s.
        lin_vel_x: forward speeds, m/s.
        ang_vel_z: yaw rates, rad/s.
        band: share of the command within which the velocity has settled.
    """

    episodes: Count
    stand_s: Positive
    drive_s: Positive
    lin_vel_x: list[float]
    ang_vel_z: list[float]
    band: Share


@dataclass(frozen=True)
class Push:
    """``protocol.push``: the hardest push that a standing robot survives, found by bisection for each episode.

    Attributes:
        episodes: number of episodes per direction and duration.
        directions: number of directions, evenly around the robot, the first forward.
        pulses_s: durations of the change of velocity, s; 0 is a kick.
        at_s: start of the push, s.
        after_s: time that the robot must survive from then on, s.
        highest: largest change of velocity, m/s.
        iterations: number of bisection steps.
        reference: change of velocity of the push whose recovery is timed, m/s.
        recovered_tilt: largest tilt of a recovered robot, rad.
        recovered_height: largest distance of a recovered base from its target height, m.
        recovered_s: time for which both must hold, s.
        within_s: longest time to recovery after the push, s.
    """

    episodes: Count
    directions: Count
    pulses_s: Annotated[list[NonNegative], NotEmpty()]
    at_s: NonNegative
    after_s: Positive
    highest: Positive
    iterations: Count
    reference: NonNegative
    recovered_tilt: Positive
    recovered_height: Positive
    recovered_s: NonNegative
    within_s: Positive


@dataclass(frozen=True)
class Height:
    """``protocol.height``: every pair of a commanded height and a forward speed, constant over the episode.

    Attributes:
        episodes: number of episodes per pair.
        horizon_s: length of each episode, s.
        heights: heights of the base above the ground, m.
        lin_vel_x: forward speeds, m/s.
    """

    episodes: Count
    horizon_s: Positive
    heights: Annotated[list[Positive], NotEmpty()]
    lin_vel_x: Speeds


@dataclass(frozen=True)
class GetUp:
    """``protocol.get_up``: getting up from poses in which the limp robot came to rest.

    Attributes:
        episodes: number of episodes.
        num_poses: number of resting poses.
        at_s: start of the time to get up, s.
        after_s: duration of an episode from then on, s.
        recovered_tilt: largest tilt of a standing robot, rad.
        recovered_height: largest distance of a standing robot's base from its target height, m.
        recovered_s: shortest time for which the robot must stand at the end, s.
        within_s: longest time to get up, s.
        ramp_s: time in which the gains of the drives rise from 0 to their values at the start, s.
    """

    episodes: Count
    num_poses: Count
    at_s: NonNegative
    after_s: Positive
    recovered_tilt: Positive
    recovered_height: Positive
    recovered_s: NonNegative
    within_s: Positive
    ramp_s: NonNegative


@dataclass(frozen=True)
class Jump:
    """``protocol.jump``: one commanded jump, standing, driving, or turning, without errors and in each changed world.

    Attributes:
        episodes: number of episodes per pair of a speed and a yaw rate.
        lin_vel_x: forward speeds, m/s.
        ang_vel_z: yaw rates, rad/s.
        at_s: time of the command to jump, s.
        height: commanded clearance of the wheels, m; policies without commanded heights do not observe it.
        after_s: time from the command to the end of the episode, s.
        clearance: clearance of all wheels that counts as a jump, m; null means the wheels' radius.
        recovered_tilt: largest tilt of a robot that has landed, rad.
        recovered_height: largest distance of its base from the target height, m.
        recovered_s: time at the end for which tilt and height must stay within their limits, s.
        within_s: longest time from the command to the end of the landing, s.
        speed_error: largest error of the mean forward speed in the second before the command to jump, m/s.
        yaw_rate_error: largest error of the mean yaw rate in the same second, rad/s.
        turn_share: smallest mean yaw rate from the command to ``within_s`` later, as a share of a commanded yaw rate.
        quiet_drift: largest drift of a quiet robot after ``within_s``, m.
        quiet_yaw: largest angle by which it turns in this time, rad.
        quiet_chatter: largest mean acceleration of its actions in this time, 1/s².
        errors: whether the jumps are repeated with the task's errors (``env.realism``).
        delay_s: delays of the actions with which the jumps are repeated, s.
    """

    episodes: Count
    lin_vel_x: Speeds
    ang_vel_z: Speeds
    at_s: NonNegative
    height: Positive
    after_s: Positive
    clearance: Positive | None
    recovered_tilt: Positive
    recovered_height: Positive
    recovered_s: NonNegative
    within_s: Positive
    speed_error: Positive
    yaw_rate_error: Positive
    turn_share: Share
    quiet_drift: Positive
    quiet_yaw: Positive
    quiet_chatter: Positive
    errors: bool
    delay_s: list[Positive]


@dataclass(frozen=True)
class Terrain:
    """``protocol.terrain`` and ``protocol.bump``: driving straight on one tile per episode, by kind and level.

    Attributes:
        episodes: number of episodes per tile.
        horizon_s: length of each episode, s.
        lin_vel_x: forward speed, m/s; the robot must not leave its tile.
        distance_share: share of the commanded distance from which an episode has succeeded.
        pass_share: share of successes from which a level is passed.
        size: edges of a tile, m.
        levels: number of levels.
        scene: the scene whose terrain has the kinds of tiles.
    """

    episodes: Count
    horizon_s: Positive
    lin_vel_x: float
    distance_share: Share
    pass_share: Share
    size: Annotated[list[Positive], Length(2)]
    levels: Count
    scene: Parameters


def _room_behind(lin_vel_x: float, horizon_s: float, before: float, length: float) -> Iterator[Broken]:
    way, there = lin_vel_x * horizon_s, before + length
    if way <= there:
        message = f"in {horizon_s:g} s the commanded distance, {way:g} m, does not reach beyond the strip"
        yield Broken("horizon_s", message, f"more than {there / lin_vel_x:g} s")


@relation(_room_behind)
@dataclass(frozen=True)
class Strip:
    """``protocol.strip``: straight from level ground over a strip of rough ground to level ground.

    Attributes:
        episodes: number of episodes per strip.
        horizon_s: length of each episode, s.
        lin_vel_x: forward speed, m/s.
        amplitudes: roughness of each strip: its heights are drawn from U(-a, a), m.
        before: distance from the start to the strip, m.
        length: length of the strip, m.
        width: width of the strip, m.
        horizontal_scale: spacing of the drawn heights, m.
        vertical_scale: step of the heights, m.
        distance_share: share of the commanded distance from which an episode has succeeded.
        quiet_s: time before the strip over which the pitch is measured, s.
        quiet_factor: largest pitch swing of a recovered robot, as a factor on the swing before the strip.
        quiet_floor: largest RMS pitch swing, rad, at which the robot always counts as recovered.
        recovered_s: time over which the swing is measured, s.
        within_s: longest time to recovery after the strip, s.
    """

    episodes: Count
    horizon_s: Positive
    lin_vel_x: Positive
    amplitudes: Annotated[list[Positive], NotEmpty()]
    before: Positive
    length: Positive
    width: Positive
    horizontal_scale: Positive
    vertical_scale: Positive
    distance_share: Share
    quiet_s: Positive
    quiet_factor: Positive
    quiet_floor: Positive
    recovered_s: Positive
    within_s: Positive


KICK_S, AFTER_KICK_S = 2.0, 2.0  # s; time of the kick from the start of the episode, and least time after the kick
# The properties that the robustness test changes, in the order of the results.
PROPERTIES = (
    *("friction", "impratio", "mass", "com", "gains", "noise", "delay_s", "reading_delay_s", "lost_readings"),
    *("imu_tilt", "gyro_bias", "encoder_offset", "slope", "kick", "payload", "platform"),
)
# A property that is unchanged at 0 has a margin: the largest change that a policy survives.
_WITH_MARGIN = tuple(name for name in PROPERTIES if name not in ("friction", "impratio", "mass", "gains"))


def _changes_are_known(
    combined: dict[str, float] | None, margins: dict[str, float] | None, kick: list[float], horizon_s: float
) -> Iterator[Broken]:
    changes, tried = combined or {}, margins or {}
    for key, given, known in (("combined", changes, PROPERTIES), ("margins", tried, _WITH_MARGIN)):
        for name, value in given.items():
            annotation = typing.get_type_hints(Robust, include_extras=True).get(name, Any)
            if name not in known:
                nearest = nearest_name(name, known)
                hint = f"; did you mean '{nearest}'?" if nearest else ""
                yield Broken(f"{key}.{name}", f"there is no such change{hint}", "one of " + ", ".join(known))
            elif value_errors(name, [value], annotation):
                yield Broken(f"{key}.{name}", f"{value} is out of range", f"a value that robust.{name} accepts")
    if {"mass", "payload"} <= changes.keys():
        yield Broken("combined.payload", "a payload would replace the change of mass", "one of mass, payload")
    if (kick or "kick" in changes or "kick" in tried) and horizon_s < KICK_S + AFTER_KICK_S:
        message = f"an episode of {horizon_s:g} s ends too early after the kick at {KICK_S:g} s"
        yield Broken("horizon_s", message, f"at least {KICK_S + AFTER_KICK_S:g} s, or no kick")


@relation(_changes_are_known)
@dataclass(frozen=True)
class Robust:
    """``protocol.robust``: one property of the world changed at a time, the same for every episode.

    Attributes:
        episodes: number of episodes per value and command.
        horizon_s: length of each episode, s.
        lin_vel_x: forward speeds, m/s.
        friction: coefficients between the robot and the ground.
        impratio: ratios of frictional to normal impedance of the contacts; wheels creep less with larger ones.
        mass: factors on the masses of all bodies.
        com: shifts of the base's centre of mass along x, m.
        gains: factors on kp and kd of all actuators.
        noise: factors on ``noise_std``.
        noise_std: standard deviation of the observation noise by the name of the observation's function, in its unit.
        delay_s: delays of the actions, s, rounded to physics steps.
        reading_delay_s: delays of the observations in ``noise_std``, s, rounded to physics steps.
        lost_readings: probability that a control step has no new reading of an observation in ``noise_std``.
        imu_tilt: pitch of the IMU relative to the base, rad.
        gyro_bias: bias of the gyroscope about all axes, rad/s.
        encoder_offset: each joint's encoder has an offset that is drawn from ± this value, rad.
        slope: slope of the floor in a random direction, rad.
        kick: change of the speed forwards, and in every second episode backwards, m/s.
        payload: mass that is added to the base, kg.
        platform: peak acceleration of a floor that swings to and fro, m/s²; docs/evaluation.md has the frequency.
        combined: several of these changes at once, by name.
        margins: the changes whose largest survived value is searched, each with the largest value to try.
        margin_survival: share of episodes that must survive a value.
        margin_iterations: bisection steps for each margin.
    """

    episodes: Count
    horizon_s: Positive
    lin_vel_x: Speeds
    friction: list[Positive]
    mass: list[Positive]
    com: list[float]
    gains: list[Positive]
    noise: list[NonNegative]
    noise_std: dict[str, NonNegative]
    delay_s: list[NonNegative]
    reading_delay_s: list[NonNegative]
    lost_readings: list[Share]
    imu_tilt: list[float]
    gyro_bias: list[float]
    encoder_offset: list[NonNegative]
    slope: list[NonNegative]
    kick: list[float]
    combined: dict[str, float] | None
    margins: dict[str, Positive] | None
    margin_survival: Share
    margin_iterations: Count
    impratio: list[Positive] = field(default_factory=list)
    payload: list[NonNegative] = field(default_factory=list)
    platform: list[NonNegative] = field(default_factory=list)


@relation(_something_counts)
@dataclass(frozen=True)
class Protocol:
    """``protocol``: fixed scenarios and their evaluation.

    Attributes:
        name: name of the protocol in results.
        seed: seed of the scenarios: of all starts and randomisations.
        settle_s: time at the start of each episode that only survival counts: the drop, s.
        command: the task's velocity command that the protocol sets.
        fall_tilt: tilt from which a robot has fallen, rad, whatever the task's terminations are.
        contact_force: force from which a wheel is on the ground, N.
        torque_deadband: share of the effort limit above which the sign of a torque counts.
        saturation: share of the effort limit from which an actuator is saturated.
        target_height: height of the base over the ground, m; null takes the height that the task's rewards name.
        ground: ``flat``: a plane with the task's friction; ``own``: the task's ground.
        realism: ``none``: without the errors of ``env.realism``; ``own``: with the task's own errors.
        resamples: number of bootstrap resamples behind each interval.
        stand: standing.
        walk: the grid of commands.
        steps: responses to command steps.
        height: the grid of commanded heights and speeds.
        push: recovery from pushes.
        jump: a commanded jump.
        get_up: getting up from resting poses.
        terrain: driving over tiles of rough ground.
        bump: the same, with jumps after bumps; skipped if the task has no jump command.
        strip: driving from level ground over rough ground and back.
        robust: standing and driving in a changed world.
    """

    name: str
    seed: Seed
    settle_s: NonNegative
    command: str
    fall_tilt: Positive
    contact_force: NonNegative
    torque_deadband: Share
    saturation: Share
    target_height: Positive | None
    ground: Ground
    realism: Literal["none", "own"]
    resamples: Count
    stand: Stand | None = None
    walk: Walk | None = None
    steps: Steps | None = None
    height: Height | None = None
    push: Push | None = None
    jump: Jump | None = None
    get_up: GetUp | None = None
    terrain: Terrain | None = None
    bump: Terrain | None = None
    strip: Strip | None = None
    robust: Robust | None = None


@dataclass(frozen=True)
class EvaluateRoot:
    """The top-level config keys of ``wheelleg evaluate``, which include ``env`` and ``agent`` of the evaluated run."""

    seed: Seed
    protocol: Protocol
    env: EnvOptions
    agent: Learning
