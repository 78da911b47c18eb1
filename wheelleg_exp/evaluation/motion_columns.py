"""Columns of standing, walking, and stepping episodes: one number per episode.

They measure posture and drift, errors and skill on a grid of commands, responses to command steps, and the motors:
torque, saturation, energy, and chatter.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from wheelleg_exp.evaluation.evaluation_env import RobotParts
from wheelleg_exp.evaluation.protocol_options import Steps, Walk
from wheelleg_exp.evaluation.trajectories import Trajectories, at, largest, last_exit, mean, rms, slope, total

Columns = dict[str, torch.Tensor]


def survival(made: Trajectories, moments: Sequence[float]) -> Columns:
    """Return whether each episode lived to the end and to some moments, and when it failed; (N,) each.

    ``time_to_failure_s`` is the horizon where there was none: so its mean is of a censored time, and no more than it.
    """
    fell, horizon = made.fell_at, made.steps
    columns = {"survived": (fell == 0).double()}
    for moment in moments:
        step = round(moment / made.dt)
        if step <= horizon:
            columns[f"survived_{moment:g}s"] = ((fell == 0) | (fell > step)).double()
    columns["time_to_failure_s"] = torch.where(fell > 0, fell, horizon).double() * made.dt
    return columns


def posture(made: Trajectories, settle_s: float, target: float | None) -> Columns:
    """Return height and attitude over the steps after settling; (N,) each, NaN where an episode was shorter."""
    counted = made.counted(settle_s)
    columns = {} if target is None else {"height_rmse_m": rms(made.height - target, counted)}
    return columns | {
        "height_mean_m": mean(made.height, counted),
        "pitch_rms_rad": rms(made.pitch, counted),
        "pitch_std_rad": rms(made.pitch.double() - mean(made.pitch, counted), counted),
        "roll_rms_rad": rms(made.roll, counted),
        "pitch_rate_rms_rad_s": rms(made.ang[..., 1], counted),
        "lean_rad": mean(made.pitch, counted),
    }


def drift(made: Trajectories, settle_s: float) -> Columns:
    """Return how far each robot strays from where it was when it had settled; (N,) each.

    ``drift_max_m`` is max‖xy - xy(settle)‖, ``drift_speed_m_s`` the size of the least-squares slope of xy,
    ``yaw_drift_rad`` max|yaw - yaw(settle)| and ``yaw_drift_rad_s`` the size of its slope.
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


def stance(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return the share of steps with every wheel down, and how unlike left and right legs are, rad; (N,) each."""
    counted = made.counted(settle_s)
    columns = {}
    if len(parts.wheels):
        columns["wheels_down_share"] = mean(made.down.all(dim=-1), counted)
    if len(parts.left):
        difference = made.joint_pos[..., parts.left] * parts.sign - made.joint_pos[..., parts.right]
        columns["leg_symmetry_rms_rad"] = rms(difference, counted)
    return columns


def tracking(made: Trajectories, settle_s: float, options: Walk) -> Columns:
    """Return errors and skill on both commanded axes; (N,) each.

    With the command c and the velocity v in the base's axes, over the steps after settling:

    * ``error_<axis>``: √mean (v - c)² while the episode lived;
    * ``error_<axis>_with_falls``: the same, but of an episode that fell no less than |c|, the error of standing
      still: an early fall must not look better than a late one;
    * ``velocity_<axis>``: mean v from ``steady_s`` on;
    * ``score_<axis>``: mean exp(-(v - c)²/std²) over all steps to the horizon, 0 after a fall;
      ``still_<axis>``: exp(-c²/std²), what standing still would have earned.
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
        columns[f"error_{name}_with_falls"] = torch.where(made.fell, torch.fmax(own, command.abs()), own)
        columns[f"velocity_{name}"] = mean(velocity, steady)
        earned = torch.where(settled, (-(error**2) / std**2).exp(), 0.0).sum(dim=0)
        columns[f"score_{name}"] = earned / steps
        columns[f"still_{name}"] = (-(command**2) / std**2).exp()
    return columns


def wheel_error(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return ``error_wheels_m_s``: RMS of how much faster the base is over each wheel than it was told to be; (N,).

    At a distance y to the left of the base it is told to move at v - w y, with the commanded speed v and yaw rate w:
    what both errors come to on the ground. Nothing of a robot that has no way forwards.
    """
    if parts.wheel_offsets is None:
        return {}
    forwards = (made.vel[..., 0] - made.command[..., 0]).double()
    turning = (made.ang[..., 2] - made.command[..., 2]).double()
    settled = made.counted(settle_s)
    each = torch.stack([rms(forwards - turning * offset, settled) for offset in parts.wheel_offsets.double()])
    return {"error_wheels_m_s": each.square().mean(dim=0).sqrt()}


def errors(made: Trajectories, settle_s: float) -> Columns:
    """Return ``error_<axis>``: √mean (v - c)² of both axes after settling, while the episode lived; (N,) each."""
    settled = made.counted(settle_s)
    return {
        "error_vx": rms(made.vel[..., 0] - made.command[..., 0], settled),
        "error_wz": rms(made.ang[..., 2] - made.command[..., 2], settled),
    }


def within_band(made: Trajectories, columns: Columns, options: Walk) -> Columns:
    """Return how far steady velocities are off, and whether episodes are within the band; (N,) each.

    ``off_<axis>`` is the size of the mean velocity's error as a share of the command, or of the smallest command of
    the grid that is not 0 where the command is 0; infinite for who fell. ``in_band`` is 1 where both are at most
    ``options.band``, else 0. ``sign_<axis>`` is 1 where the robot moves the way that it was told to, 0 where it does
    not or fell.
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
    """Return how the three steps were answered; (N,) each, NaN for what a fall or a velocity outside its band hides.

    * ``settle_s``: after the step 0 → c, until the velocity is last outside the band around c;
    * ``overshoot``: largest velocity beyond c while driving, as a share of c;
    * ``reversal_s``: after the step c → -c, likewise to the band around -c;
    * ``stop_s``: after the step -c → 0, until the speed is last above the band;
    * ``stop_distance``: how far the robot goes on after that, along where it was heading, m, or turns, rad.

    ``asked`` is c of each episode, (N, 3). Of stops there are those alone of robots that were driving as told.

    ``<answer>_did`` is 1 where there was such a time, else 0. The turning episodes have their columns with ``_wz``,
    the driving ones with ``_vx``.
    """
    begin, drive, dt = float(options.stand_s), float(options.drive_s), made.dt
    windows = [made.counted(begin + k * drive, begin + (k + 1) * drive) for k in range(3)]
    lived = ~made.fell
    columns: Columns = {}
    for name, velocity, column in (("vx", made.vel[..., 0], 0), ("wz", made.ang[..., 2], 2)):
        command = asked[:, column].double()
        mine = command != 0.0
        share = velocity.double() / torch.where(mine, command, 1.0)  # 1 is the command, whatever its sign

        def kept(values: torch.Tensor, mine: torch.Tensor = mine) -> torch.Tensor:
            return torch.where(mine & lived, values, torch.nan)

        columns[f"settle_s_{name}"] = kept(last_exit((share - 1.0).abs() > options.band, windows[0], dt))
        columns[f"overshoot_{name}"] = kept(largest(share - 1.0, windows[0]).clamp(min=0.0))
        columns[f"reversal_s_{name}"] = kept(last_exit((share + 1.0).abs() > options.band, windows[1], dt))
        drove = at(share, windows[2]) < -options.band  # who never moved, or moved another way, has nothing to stop
        columns[f"stop_s_{name}"] = kept(last_exit(share.abs() > options.band, windows[2], dt), mine & drove)
        for answer in ("settle", "reversal", "stop"):  # whether it did at all
            did = columns[f"{answer}_s_{name}"].isfinite().double()
            columns[f"{answer}_did_{name}"] = torch.where(mine, did, torch.nan)
        beyond = largest(_beyond(made, name, windows[2], command), windows[2])
        columns[f"stop_distance_{name}"] = kept(beyond, mine & drove)
    return columns


def _beyond(made: Trajectories, name: str, window: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
    """Return how far each robot is beyond where it was told to stop, along -c, (T, N), m or rad."""
    yaw = made.unwrapped_yaw()
    if name == "wz":
        return (yaw - at(yaw, window)) * -command.sign()
    heading = at(yaw, window)
    way = made.pos[..., :2] - at(made.pos[..., :2], window)
    return (way[..., 0] * heading.cos() + way[..., 1] * heading.sin()) * -command.sign()


_SPEED_HZ = 10.0  # from here on power is chatter: a body of this size moves at a few hertz


def effort(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return torques and saturation of each actuator group, and the wheels' speed and sign changes; (N,) each.

    ``torque_rms_<group>`` is over joints and physics steps, N·m; ``torque_share_<group>`` the same as a share of each
    joint's effort limit; ``saturation_<group>`` the share of physics steps at the limit, ``saturation_max_<group>``
    that of the joint that is there most. ``wheel_sign_changes_per_s`` counts, per wheel, how often the torque passes
    from beyond the dead band on one side to beyond it on the other.
    """
    counted = made.counted(settle_s)
    columns: Columns = {}
    for name, joints in parts.groups.items():
        torque, limit = made.torque_rms[..., joints], parts.effort_limit[:, joints]
        columns[f"torque_rms_{name}_nm"] = rms(torque, counted)
        columns[f"torque_share_{name}"] = rms(torque / limit, counted)
        columns[f"saturation_{name}"] = mean(made.saturated[..., joints], counted)
        each = [mean(made.saturated[..., joint], counted) for joint in joints.tolist()]
        columns[f"saturation_max_{name}"] = torch.stack(each).amax(dim=0)
    if len(parts.wheels):
        columns["wheel_sign_changes_per_s"] = mean(made.sign_changes, counted) / made.dt
        columns["wheel_speed_rms_rad_s"] = rms(made.joint_vel[..., parts.wheels], counted)
    return columns


def energy(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return power, work and cost of transport after settling; (N,) each.

    Gross counts ∑|τ q̇| Δt, net ∑|(τ - I_a q̈) q̇| Δt: without what swings the armature. The cost of transport is
    energy / (m g d) with d the length of the way in the plane; NaN for robots that were told to stand.
    """
    counted = made.counted(settle_s)
    duration = counted.sum(dim=0) * made.dt
    gross, net, positive = (total(made.work[..., k], counted) for k in range(3))
    way = torch.zeros_like(made.height)
    way[1:] = torch.linalg.vector_norm(made.pos[..., :2].diff(dim=0), dim=-1)
    distance = total(way, counted)
    drives = (made.command[0] != 0.0).any(dim=-1)
    weight = torch.where(drives, parts.mass * parts.gravity * distance, torch.nan)
    return {
        "power_gross_w": gross / duration,
        "power_net_w": net / duration,
        "positive_work_j": positive,
        "peak_power_w": largest(made.work[..., 3], counted),
        "distance_m": distance,
        "cost_of_transport_gross": gross / weight,
        "cost_of_transport_net": net / weight,
    }


def smoothness(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return how much actions and torques jump from step to step; (N,) each.

    ``action_rate_per_s`` is mean|Δa|/Δt, ``action_acceleration_per_s2`` mean|Δ²a|/Δt², over the action's components;
    ``torque_difference_rms_nm`` the RMS of a control step's change of torque; ``fast_power_share`` the share of the
    driven joints' torque power spectrum, its mean left out, above 10 Hz (of episodes that lived to the end).
    Both sample the torque at the last physics step of each control step.
    """
    counted, dt = made.counted(settle_s), made.dt
    later, latest = counted[1:] & counted[:-1], counted[2:] & counted[1:-1] & counted[:-2]
    first = made.action.double().diff(dim=0)
    driven = torch.cat(list(parts.groups.values()))
    torque = made.torque[..., driven]
    return {
        "action_rate_per_s": mean(first.abs(), later) / dt,
        "action_acceleration_per_s2": mean(first.diff(dim=0).abs(), latest) / dt**2,
        "torque_difference_rms_nm": rms(torque.diff(dim=0), later),
        "fast_power_share": fast_share(torque, counted, dt),
    }


def fast_share(values: torch.Tensor, counted: torch.Tensor, dt: float) -> torch.Tensor:
    """Return the share of the power of (T, N, J) above 10 Hz, (N,); NaN for who does not count to the end.

    A still signal has no power, and so none that is fast: 0.
    """
    whole = counted[-1]
    begin = int(counted.any(dim=1).int().argmax()) if bool(counted.any()) else 0
    window = values[begin:].double()
    power = torch.fft.rfft(window - window.mean(dim=0), dim=0).abs().square().sum(dim=-1)
    frequency = torch.fft.rfftfreq(len(window), dt, device=values.device)
    share = power[frequency > _SPEED_HZ].sum(dim=0) / power.sum(dim=0).clamp(min=1e-12)
    return torch.where(whole, share, torch.nan)
