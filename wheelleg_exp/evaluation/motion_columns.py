"""Compute columns (one number per episode): drift, tracking errors, responses to command steps, and motor effort."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from wheelleg_exp.evaluation.evaluation_env import RobotParts
from wheelleg_exp.evaluation.protocol_options import Jump, Steps, Walk
from wheelleg_exp.evaluation.trajectories import Trajectories, at, largest, last_exit, mean, rms, slope, total
from wheelleg_exp.mdp.root_motion import resting_side
from wheelleg_exp.sim import rotation

Columns = dict[str, torch.Tensor]
_SPEED_HZ = 10.0  # Signal power above 10 Hz counts as chatter, because a robot moves at a few hertz.


@dataclass(frozen=True)
class Motion:
    """The recorded motion of N episodes, with methods that average over the steps after the settling time ``settle_s``.

    ``target`` is the target height of the base, m, one for all episodes or (N,).
    """

    made: Trajectories
    parts: RobotParts
    settle_s: float
    target: float | torch.Tensor | None = None

    @cached_property
    def counted(self) -> torch.Tensor:
        """A bool mask (T, N) of the control steps after the settling time and before the end of the episode."""
        return self.made.counted(self.settle_s)

    @property
    def wheels(self) -> bool:
        """Whether the robot has wheels."""
        return len(self.parts.wheels) > 0

    @property
    def duration(self) -> torch.Tensor:
        """The duration of each episode after the settling time, s, (N,)."""
        return self.counted.sum(dim=0) * self.made.dt

    @property
    def distance(self) -> torch.Tensor:
        """The length of each robot's path in the horizontal plane, m, (N,)."""
        return self.total(self.step_lengths)

    @property
    def step_lengths(self) -> torch.Tensor:
        """The horizontal distance that each robot moves in each control step, m, (T, N)."""
        lengths = torch.zeros_like(self.made.height)
        lengths[1:] = torch.linalg.vector_norm(self.made.pos[..., :2].diff(dim=0), dim=-1)
        return lengths

    @property
    def weight_distance(self) -> torch.Tensor:
        """The robot's weight times its path length, J, (N,), for the cost of transport; NaN for a zero command."""
        drives = (self.made.command[0] != 0.0).any(dim=-1)
        return torch.where(drives, self.parts.mass * self.parts.gravity * self.distance, torch.nan)

    @property
    def driven_torque(self) -> torch.Tensor:
        """The torques of the joints with motors at the last physics step of each control step, N·m, (T, N, J)."""
        return self.made.torque[..., torch.cat(list(self.parts.groups.values()))]

    def mean(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mean of ``values`` (T, N, ...) over trailing axes and all steps after the settling time, (N,)."""
        return mean(values, self.counted)

    def rms(self, values: torch.Tensor) -> torch.Tensor:
        """Return the RMS of ``values`` (T, N, ...) over trailing axes and all steps after the settling time, (N,)."""
        return rms(values, self.counted)

    def total(self, values: torch.Tensor) -> torch.Tensor:
        """Return the sum of ``values`` (T, N) over all control steps after the settling time, (N,)."""
        return total(values, self.counted)

    def largest(self, values: torch.Tensor) -> torch.Tensor:
        """Return the largest of ``values`` (T, N) over all control steps after the settling time, (N,)."""
        return largest(values, self.counted)

    def leg_asymmetry(self) -> torch.Tensor | None:
        """Return the RMS difference between the positions of left and mirrored right leg joints, rad, (N,)."""
        parts, joints = self.parts, self.made.joint_pos
        left = len(parts.left)
        return self.rms(joints[..., parts.left] * parts.sign - joints[..., parts.right]) if left else None

    def action_change(self, order: int) -> torch.Tensor:
        """Return the mean absolute value of the actions' time derivative of the given order, 1/s^order, (N,)."""
        change, counted = self.made.action.double(), self.counted
        for _ in range(order):
            change, counted = change.diff(dim=0), counted[1:] & counted[:-1]
        return mean(change.abs(), counted) / self.made.dt**order

    def fast_power_share(self) -> torch.Tensor:
        """Return the share of the motor torques' spectral power above 10 Hz, (N,); NaN for ended episodes."""
        torque, counted = self.driven_torque, self.counted
        begin = int(counted.any(dim=1).int().argmax()) if bool(counted.any()) else 0
        window = torque[begin:].double()
        power = torch.fft.rfft(window - window.mean(dim=0), dim=0).abs().square().sum(dim=-1)
        frequency = torch.fft.rfftfreq(len(window), self.made.dt, device=torque.device)
        share = power[frequency > _SPEED_HZ].sum(dim=0) / power.sum(dim=0).clamp(min=1e-12)
        return torch.where(counted[-1], share, torch.nan)


def survival(made: Trajectories, moments: Sequence[float]) -> Columns:
    """Return each robot's time of failure, and whether it survived until the end and until each of ``moments``, s.

    Without a failure, ``time_to_failure_s`` is the episode length, so that the mean underestimates the truth.
    """
    fell, horizon = made.fell_at, made.steps
    columns = {"survived": (fell == 0).double()}
    for moment in moments:
        step = round(moment / made.dt)
        if step <= horizon:
            columns[f"survived_{moment:g}s"] = ((fell == 0) | (fell > step)).double()
    columns["time_to_failure_s"] = torch.where(fell > 0, fell, horizon).double() * made.dt
    return columns


def drift(made: Trajectories, settle_s: float) -> Columns:
    """Return how far each of N robots drifts from its pose at the end of the settling time.

    ``drift_max_m`` and ``yaw_drift_rad`` are the largest horizontal distance and angle from then on;
    ``drift_speed_m_s`` and ``yaw_drift_rad_s`` are least-squares slopes of position and yaw over time.
    """
    counted = made.counted(settle_s)
    from_there = made.pos[..., :2] - at(made.pos[..., :2], counted)
    yaw = made.unwrapped_yaw()
    slopes = [slope(made.pos[..., axis], counted, made.dt) for axis in (0, 1)]
    return {
        "drift_max_m": largest(torch.linalg.vector_norm(from_there, dim=-1), counted),
        "drift_speed_m_s": torch.hypot(*slopes),
        "yaw_drift_rad": largest((yaw - at(yaw, counted)).abs(), counted),
        "yaw_drift_rad_s": slope(yaw, counted, made.dt).abs(),
    }


def tracking(made: Trajectories, settle_s: float, options: Walk) -> Columns:
    """Return tracking errors and scores for both commanded axes, forward speed and yaw rate; (N,) each.

    With the command c and the velocity v in the base's axes, after settling:

    * ``error_<axis>``: √mean (v - c)² while the episode survives;
    * ``error_<axis>_transient`` and ``_steady``: the same before and from ``steady_s`` on;
    * ``error_<axis>_with_falls``: the same, but at least |c|, the error of standing still, for an episode that fell;
    * ``velocity_<axis>``: mean v from ``steady_s`` on;
    * ``score_<axis>``: mean exp(-(v - c)²/std²) over all steps to the horizon, 0 after a fall;
    * ``still_<axis>``: exp(-c²/std²), the score of standing still.
    """
    columns: Columns = {}
    axes = (("vx", made.vel[..., 0], 0, options.std_lin_vel_x), ("wz", made.ang[..., 2], 2, options.std_ang_vel_z))
    settled, steady = made.counted(settle_s), made.counted(options.steady_s)
    steps = made.steps - round(settle_s / made.dt)
    for name, velocity, column, std in axes:
        command = made.command[0, :, column].double()
        error = velocity.double() - made.command[..., column].double()
        own = rms(error, settled)
        columns[f"error_{name}"] = own
        columns[f"error_{name}_transient"] = rms(error, made.counted(settle_s, options.steady_s))
        columns[f"error_{name}_steady"] = rms(error, steady)
        columns[f"error_{name}_with_falls"] = torch.where(made.fell, torch.fmax(own, command.abs()), own)
        columns[f"velocity_{name}"] = mean(velocity, steady)
        columns[f"score_{name}"] = torch.where(settled, (-(error**2) / std**2).exp(), 0.0).sum(dim=0) / steps
        columns[f"still_{name}"] = (-(command**2) / std**2).exp()
    return columns


def wheel_error(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return ``error_wheels_m_s``: the RMS error of the velocity over each wheel; (N,).

    A point y to the left of the base has the commanded velocity v - w y. Without a forward direction, return no column.
    """
    if parts.wheel_offsets is None:
        return {}
    forwards = (made.vel[..., 0] - made.command[..., 0]).double()
    turning = (made.ang[..., 2] - made.command[..., 2]).double()
    settled = made.counted(settle_s)
    each = torch.stack([rms(forwards - turning * offset, settled) for offset in parts.wheel_offsets.double()])
    return {"error_wheels_m_s": each.square().mean(dim=0).sqrt()}


def errors(made: Trajectories, settle_s: float) -> Columns:
    """Return ``error_<axis>``: √mean (v - c)² of both axes after settling, while the episode survives; (N,) each."""
    settled = made.counted(settle_s)
    return {
        "error_vx": rms(made.vel[..., 0] - made.command[..., 0], settled),
        "error_wz": rms(made.ang[..., 2] - made.command[..., 2], settled),
    }


def within_band(made: Trajectories, columns: Columns, options: Walk) -> Columns:
    """Return the steady-state velocity errors, and whether they are within the tolerance band; (N,) each.

    ``off_vx`` and ``off_wz`` are the absolute errors of mean forward speed and mean yaw rate, divided by the command;
    inf after a fall. If a velocity command is zero, the velocity error is divided by the smallest nonzero command.
    ``in_band`` is 1 if the robot did not fall and both velocity errors are at most ``options.band``, else 0.
    ``sign_<axis>`` is 1 if the robot did not fall and moves in the commanded direction, else 0.
    """
    found: Columns = {}
    good = ~made.fell
    for name, column, grid in (("vx", 0, options.lin_vel_x), ("wz", 2, options.ang_vel_z)):
        command = made.command[0, :, column].double()
        velocity = columns[f"velocity_{name}"]
        least = min((abs(value) for value in grid if value), default=1.0)
        off = (velocity - command).abs() / command.abs().clamp(min=least)
        found[f"off_{name}"] = torch.where(made.fell, torch.inf, off)
        found[f"sign_{name}"] = (~made.fell & (velocity * command > 0.0)).double()
        good = good & (off <= options.band)
    return found | {"in_band": good.double()}


def responses(made: Trajectories, options: Steps, asked: torch.Tensor) -> Columns:
    """Return settling times, overshoots, and stopping distances after steps of the velocity command; NaN after a fall.

    * ``settle_s``: after the step 0 → c, the time until the velocity stays within the band around c;
    * ``overshoot``: the largest velocity beyond c while driving, as a share of c;
    * ``reversal_s``: after the step c → -c, the time until the velocity stays within the band around -c;
    * ``stop_s``: after the step -c → 0, the time until the speed stays below the band;
    * ``stop_distance``: after the step -c → 0, the distance along the previous heading, m, or the turned angle, rad.

    ``asked`` (N, 3) is the command c of each episode. ``stop_s`` and ``stop_distance`` are NaN if the robot did not
    drive as commanded before the stop. ``settle_did``, ``reversal_did``, and ``stop_did`` are 1 if the time is not NaN,
    else 0. All columns have the suffix ``_vx`` (forward speed) or ``_wz`` (yaw rate).
    """
    begin, drive, dt = float(options.stand_s), float(options.drive_s), made.dt
    windows = [made.counted(begin + k * drive, begin + (k + 1) * drive) for k in range(3)]
    lived, yaw = ~made.fell, made.unwrapped_yaw()
    columns: Columns = {}
    for name, velocity, column in (("vx", made.vel[..., 0], 0), ("wz", made.ang[..., 2], 2)):
        command = asked[:, column].double()
        mine = command != 0.0
        share = velocity.double() / torch.where(mine, command, 1.0)  # 1 at the command

        def if_survived(values: torch.Tensor, mine: torch.Tensor = mine) -> torch.Tensor:
            return torch.where(mine & lived, values, torch.nan)

        columns[f"settle_s_{name}"] = if_survived(last_exit((share - 1.0).abs() > options.band, windows[0], dt))
        columns[f"overshoot_{name}"] = if_survived(largest(share - 1.0, windows[0]).clamp(min=0.0))
        columns[f"reversal_s_{name}"] = if_survived(last_exit((share + 1.0).abs() > options.band, windows[1], dt))
        drove = at(share, windows[2]) < -options.band
        columns[f"stop_s_{name}"] = if_survived(last_exit(share.abs() > options.band, windows[2], dt), mine & drove)
        for answer in ("settle", "reversal", "stop"):
            did = columns[f"{answer}_s_{name}"].isfinite().double()
            columns[f"{answer}_did_{name}"] = torch.where(mine, did, torch.nan)
        # ``beyond`` is the distance (m) or angle (rad) that a robot still moves after the command to stop.
        heading = at(yaw, windows[2])
        way = made.pos[..., :2] - at(made.pos[..., :2], windows[2])
        driven = way[..., 0] * heading.cos() + way[..., 1] * heading.sin()
        beyond = largest((yaw - heading if name == "wz" else driven) * -command.sign(), windows[2])
        columns[f"stop_distance_{name}"] = if_survived(beyond, mine & drove)
    return columns


def group_effort(motion: Motion) -> Columns:
    """Return the RMS torques and the saturation of each actuator group, (N,) each.

    ``torque_rms_<group>`` is the RMS over joints and physics steps, N·m; for ``torque_share_<group>``, torques are
    divided by the effort limits. ``saturation_<group>`` is the share of physics steps at the effort limit, averaged
    over joints; ``saturation_max_<group>`` is that of the most saturated joint.
    """
    columns: Columns = {}
    for name, joints in motion.parts.groups.items():
        torque, saturated = motion.made.torque_rms[..., joints], motion.made.saturated[..., joints]
        columns[f"torque_rms_{name}_nm"] = motion.rms(torque)
        columns[f"torque_share_{name}"] = motion.rms(torque / motion.parts.effort_limit[:, joints])
        columns[f"saturation_{name}"] = motion.mean(saturated)
        columns[f"saturation_max_{name}"] = torch.stack([motion.mean(one) for one in saturated.unbind(-1)]).amax(dim=0)
    return columns


def impact(motion: Motion, begin_s: float) -> Columns:
    """Return the largest change of the base's velocity between two control steps, m/s, and the largest torque, (N,).

    The torque is a joint's RMS torque in a control step, over its effort limit. Steps before ``begin_s`` do not count.
    """
    made = motion.made
    counted = made.counted(begin_s)
    quat = rotation.quat_from_euler_xyz(made.roll.flatten(), made.pitch.flatten(), made.yaw.flatten())
    velocity = rotation.rotate(rotation.quat_to_matrix(quat), made.vel.flatten(0, 1)).view_as(made.vel)
    change = torch.zeros_like(made.height)
    change[1:] = torch.linalg.vector_norm(velocity.diff(dim=0), dim=-1)
    share = made.torque_rms / motion.parts.effort_limit
    return {"impact_m_s": largest(change, counted), "torque_peak_share": largest(share.amax(dim=-1), counted)}


def jump(motion: Motion, options: Jump) -> Columns:
    """Return each jump's clearance, m, longest flight, s, and length of an obstacle that it can pass, m, (N,) each.

    ``clearance_m`` is that of the lowest wheel. ``span_m`` is the longest way of the base while all wheels have at
    least the clearance ``options.clearance``, or their radius; ``jumped`` is 1 if they reached it. ``off_speed_m_s``
    and ``off_yaw_rate_rad_s`` are the errors of mean speed and mean yaw rate in the second before the command to jump;
    ``drove`` is 1 if both are at most ``options.speed_error`` and ``options.yaw_rate_error``, else 0. ``turn_share`` is
    the mean yaw rate from the command to ``options.within_s`` later, divided by the commanded yaw rate, NaN if that is
    0; ``turned`` is 0 if the share is less than ``options.turn_share``, else 1. The columns ``quiet_*`` are those of
    ``drift`` and the mean acceleration of the actions, from ``options.within_s`` after the command on; ``quiet`` is 1
    if they are within the limits, else 0.
    """
    made, after = motion.made, motion.made.counted(options.at_s)
    before = made.counted(options.at_s - 1.0, options.at_s)
    off_speed = mean(made.vel[..., 0] - made.command[..., 0], before).abs()
    off_yaw_rate = mean(made.ang[..., 2] - made.command[..., 2], before).abs()
    min_clearance = float(motion.parts.wheel_radius.max()) if options.clearance is None else options.clearance
    lowest = made.clearance.amin(dim=-1)
    highest = largest(lowest, after)
    landed_s = options.at_s + options.within_s
    asked = made.command[0, :, 2].double()
    turned = mean(made.ang[..., 2], made.counted(options.at_s, landed_s)) / asked
    drifted = drift(made, landed_s)
    quiet = {
        "quiet_drift_m": (drifted["drift_max_m"], options.quiet_drift),
        "quiet_yaw_rad": (drifted["yaw_drift_rad"], options.quiet_yaw),
        "quiet_chatter_per_s2": (replace(motion, settle_s=landed_s).action_change(2), options.quiet_chatter),
    }
    return {
        "clearance_m": highest,
        "height_error_m": (highest - options.height).abs(),
        "air_s": _longest(torch.full_like(lowest, made.dt), ~made.down.any(dim=-1), after),
        "span_m": _longest(motion.step_lengths, lowest >= min_clearance, after),
        "jumped": (highest >= min_clearance).double(),
        "off_speed_m_s": off_speed,
        "off_yaw_rate_rad_s": off_yaw_rate,
        "drove": ((off_speed <= options.speed_error) & (off_yaw_rate <= options.yaw_rate_error)).double(),
        "turn_share": torch.where(asked == 0.0, torch.nan, turned),
        "turned": ((asked == 0.0) | (turned >= options.turn_share)).double(),
        **{name: value for name, (value, _) in quiet.items()},
        "quiet": (~made.fell & torch.stack([value <= limit for value, limit in quiet.values()]).all(dim=0)).double(),
    }


def _longest(values: torch.Tensor, chosen: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return the largest sum of ``values`` (T, N) over successive counted steps that are all chosen, (N,)."""
    chosen = chosen & counted
    sums = torch.where(chosen, values, 0.0).double().cumsum(dim=0)
    return (sums - torch.where(chosen, 0.0, sums).cummax(dim=0).values).amax(dim=0)


def resting_sides(made: Trajectories) -> Columns:
    """Return ``side``, the index in ``SIDES`` of the side on which each robot lies after the first control step."""
    roll, pitch = made.roll[0], made.pitch[0]
    gravity = torch.stack((pitch.sin(), -roll.sin() * pitch.cos(), -roll.cos() * pitch.cos()), dim=1)
    return {"side": resting_side(gravity)}
