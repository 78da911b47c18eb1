"""Options of a protocol: its tests, their number of episodes, and their length; ``configs/protocol/``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from wheelleg_exp.constraints import Broken, Count, Length, NonNegative, NotEmpty, Positive, Seed, Share, relation
from wheelleg_exp.terms.config_sections import Section

Ground = Literal["flat", "own"]
Speeds = Annotated[list[float], NotEmpty()]


def _some_step(steps: Mapping[str, Any]) -> Iterator[Broken]:
    if not steps["lin_vel_x"] and not steps["ang_vel_z"]:
        yield Broken("lin_vel_x", "there is no speed to step to", "a speed here or in ang_vel_z")


def _lengths(protocol: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the key that says how long the episodes of each test are, and how long that is, s."""
    for test in ("stand", "walk", "terrain", "strip", "robust"):
        if protocol[test] is not None:
            yield f"{test}.horizon_s", protocol[test]["horizon_s"]
    if (steps := protocol["steps"]) is not None:
        yield "steps.drive_s", steps["stand_s"] + 3 * steps["drive_s"]
    if (push := protocol["push"]) is not None:
        yield "push.after_s", push["at_s"] + push["after_s"]


def _something_counts(protocol: Mapping[str, Any]) -> Iterator[Broken]:
    lengths, settle = list(_lengths(protocol)), protocol["settle_s"]
    if not lengths:
        tests = "stand, walk, steps, push, terrain, strip, robust"
        yield Broken("", "there is no test in it", f"one of {tests} that is not null")
    for key, seconds in lengths:
        if seconds <= settle:
            message = f"an episode of {seconds:g} s is over before anything counts"
            yield Broken(key, message, f"episodes longer than protocol.settle_s, {settle:g} s")


@dataclass(frozen=True)
class Stand:
    """``protocol.stand``: the command is zero.

    Attributes:
        episodes: number of episodes.
        horizon_s: how long each is, s.
        survival_s: the moments at which survival is told, s; those after the horizon are left out.
    """

    episodes: Count
    horizon_s: Positive
    survival_s: list[Positive]


@dataclass(frozen=True)
class Walk:
    """``protocol.walk``: every pair of a forward and a turning speed, held from the start.

    Attributes:
        episodes: number of episodes of each cell of the grid.
        horizon_s: how long each is, s.
        lin_vel_x: forward speeds, m/s.
        ang_vel_z: turning speeds, rad/s.
        steady_s: from when on the mean velocity is of a steady drive, s.
        band: share of the command that a steady error may be.
        std_lin_vel_x: of the skill score's exp(-e²/std²), m/s.
        std_ang_vel_z: likewise, rad/s.
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
    """``protocol.steps``: stand, drive, reverse, stop; on one axis at a time.

    Attributes:
        episodes: number of episodes of each cell.
        stand_s: how long the robot stands first, s.
        drive_s: how long each of the three commands holds, s.
        lin_vel_x: forward speeds, m/s.
        ang_vel_z: turning speeds, rad/s.
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
    """``protocol.push``: how hard a standing robot may be pushed, found by bisection in each episode by itself.

    Attributes:
        episodes: number of episodes of each direction and kind.
        directions: number of directions, evenly around the robot, the first forwards.
        pulses_s: over how long the change of velocity is spread, s; 0 is a kick.
        at_s: when the push begins, s.
        after_s: how long the robot must live from then on, s.
        highest: largest change of velocity, m/s.
        iterations: of the bisection.
        reference: change of velocity of the push whose recovery is timed, m/s.
        recovered_tilt: tilt of who has recovered, rad.
        recovered_height: distance of the base from its target height, m, likewise.
        recovered_s: how long both must hold, s.
        within_s: by when after the push, s.
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
class Terrain:
    """``protocol.terrain``: driving straight on, one tile an episode, by kind and level.

    Attributes:
        episodes: number of episodes of each tile.
        horizon_s: how long each is, s.
        lin_vel_x: forward speed, m/s; the robot must not leave its tile.
        distance_share: share of the commanded way from which on an episode has succeeded.
        pass_share: share of successes from which on a level is passed.
        size: edges of a tile, m.
        levels: number of levels.
        scene: the scene whose ground's kinds of tiles are driven on; its other settings are the ground's own.
    """

    episodes: Count
    horizon_s: Positive
    lin_vel_x: float
    distance_share: Share
    pass_share: Share
    size: Annotated[list[Positive], Length(2)]
    levels: Count
    scene: Section


def _room_behind(strip: Mapping[str, Any]) -> Iterator[Broken]:
    way, there = strip["lin_vel_x"] * strip["horizon_s"], strip["before"] + strip["length"]
    if way <= there:
        message = f"in {strip['horizon_s']:g} s the commanded way, {way:g} m, does not lead behind the strip"
        yield Broken("horizon_s", message, f"more than {there / strip['lin_vel_x']:g} s")


@relation(_room_behind)
@dataclass(frozen=True)
class Strip:
    """``protocol.strip``: straight on from level ground over a strip of rough ground, and on, on level ground.

    Attributes:
        episodes: number of episodes of each strip.
        horizon_s: how long each is, s.
        lin_vel_x: forward speed, m/s.
        amplitudes: how rough each strip is: its heights are drawn from U(-a, a), m.
        before: where the strip begins, m from where the robot does.
        length: of the strip, m.
        width: of the strip, m.
        horizontal_scale: distance of the heights that are drawn, m.
        vertical_scale: heights are whole multiples of it, m.
        distance_share: share of the commanded way from which on an episode has succeeded.
        quiet_s: how long before the strip it is seen how quiet the robot is, s.
        quiet_factor: how many times as much as then its pitch may swing when it has recovered.
        quiet_floor: RMS swing of the pitch that counts as quiet in any case, rad.
        recovered_s: over how long that swing is taken, s.
        within_s: by when after the strip, s.
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


@dataclass(frozen=True)
class Robust:
    """``protocol.robust``: one thing of the world changed at a time, for every episode alike.

    Attributes:
        episodes: number of episodes of each value and command.
        horizon_s: how long each is, s.
        lin_vel_x: forward speeds, m/s.
        friction: coefficients between the robot and the ground.
        mass: factors on the masses of all bodies.
        com: shifts of the base's centre of mass along x, m.
        delay_s: by how much actions come late, s; whole control steps.
        noise: factors on ``noise_std``.
        noise_std: standard deviation of the noise on observations by their function's name, in its unit.
        gains: factors on kp and kd of all actuators.
    """

    episodes: Count
    horizon_s: Positive
    lin_vel_x: Speeds
    friction: list[Positive]
    mass: list[Positive]
    com: list[float]
    delay_s: list[NonNegative]
    noise: list[NonNegative]
    noise_std: dict[str, NonNegative]
    gains: list[Positive]


@relation(_something_counts)
@dataclass(frozen=True)
class Protocol:
    """``protocol``: fixed scenarios and how they are judged.

    Attributes:
        name: what results are called by.
        seed: of the scenarios: of all that starts and randomisations are drawn from.
        settle_s: seconds at the start of each episode that no metric but survival counts: the drop.
        command: the velocity command of the task that is held.
        fall_tilt: tilt from which on a robot has fallen, rad, whatever the task's terminations say.
        contact_force: force from which on a wheel is on the ground, N.
        torque_deadband: share of the effort limit that a torque must pass for its sign to count.
        saturation: share of the effort limit from which on an actuator is at it.
        target_height: of the base over the ground, m; null takes what the task's rewards name.
        ground: ``flat``: a plane with the task's friction; ``own``: the task's ground.
        resamples: of the bootstrap behind each interval.
        stand: standing.
        walk: the grid of commands.
        steps: responses to steps of the command.
        push: recovery from pushes.
        terrain: driving over tiles of rough ground.
        strip: driving from level ground over rough ground and on.
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
    resamples: Count
    stand: Stand | None = None
    walk: Walk | None = None
    steps: Steps | None = None
    push: Push | None = None
    terrain: Terrain | None = None
    strip: Strip | None = None
    robust: Robust | None = None
