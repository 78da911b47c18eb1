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
    """Return whether each episode survived to the end and to given moments, and when it failed; (N,) each.

    ``time_to_failure_s`` is the horizon without a failure. Its mean is therefore a lower bound of the true mean.
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
    """Return height and attitude after settling; (N,) each, NaN for shorter episodes."""
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
    """Return the drift of each robot from its pose after settling; (N,) each.

    ``drift_max_m`` is max‖xy - xy(settle)‖. ``drift_speed_m_s`` is the norm of the least-squares slope of xy.
    ``yaw_drift_rad`` is max|yaw - yaw(settle)|, and ``yaw_drift_rad_s`` the absolute slope of the yaw.
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
    """Return the share of steps with all wheels down, and the asymmetry of left and right legs, rad; (N,) each."""
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

    With the command c and the velocity v in the base's axes, after settling:

    * ``error_<axis>``: √mean (v - c)² while the episode survives;
    * ``error_<axis>_with_falls``: the same, but at least |c| for an episode that fell. |c| is the error of standing
      still; so an early fall is never better than a late one.
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
        columns[f"error_{name}_with_falls"] = torch.where(made.fell, torch.fmax(own, command.abs()), own)
        columns[f"velocity_{name}"] = mean(velocity, steady)
        earned = torch.where(settled, (-(error**2) / std**2).exp(), 0.0).sum(dim=0)
        columns[f"score_{name}"] = earned / steps
        columns[f"still_{name}"] = (-(command**2) / std**2).exp()
    return columns


def wheel_error(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return ``error_wheels_m_s``: the RMS error of the velocity over each wheel; (N,).

    A point at a distance y to the left of the base is commanded to move at v - w y, with the commanded speed v and yaw
    rate w. The result is empty for a robot without a forward direction.
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
    """Return the errors of steady velocities, and whether episodes are within the band; (N,) each.

    ``off_<axis>`` is the absolute error of the mean velocity as a share of the command. If the command is 0, the grid's
    smallest nonzero command replaces it. A fallen episode has inf. ``in_band`` is 1 if both are at most
    ``options.band``, else 0. ``sign_<axis>`` is 1 if the robot moves in the commanded direction, and 0 if not or after
    a fall.
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
    """Return the responses to three command steps; (N,) each, NaN after a fall or a missing response.

    * ``settle_s``: after the step 0 → c, the time until the velocity stays within the band around c;
    * ``overshoot``: largest velocity beyond c while driving, as a share of c;
    * ``reversal_s``: after the step c → -c, the same for the band around -c;
    * ``stop_s``: after the step -c → 0, the time until the speed stays below the band;
    * ``stop_distance``: distance after that step along the previous heading, m, or the turned angle, rad.

    ``asked`` is c of each episode, (N, 3). The stop columns only exist for robots that drove as commanded.

    ``<answer>_did`` is 1 if there is such a time, else 0. Columns end in ``_wz`` for turning and ``_vx`` for driving.
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
        drove = at(share, windows[2]) < -options.band  # a robot that did not drive as commanded cannot stop
        columns[f"stop_s_{name}"] = kept(last_exit(share.abs() > options.band, windows[2], dt), mine & drove)
        for answer in ("settle", "reversal", "stop"):
            did = columns[f"{answer}_s_{name}"].isfinite().double()
            columns[f"{answer}_did_{name}"] = torch.where(mine, did, torch.nan)
        beyond = largest(_beyond(made, name, windows[2], command), windows[2])
        columns[f"stop_distance_{name}"] = kept(beyond, mine & drove)
    return columns


def _beyond(made: Trajectories, name: str, window: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
    """Return the distance of each robot beyond the place of its stop command, along -c, (T, N), m or rad."""
    yaw = made.unwrapped_yaw()
    if name == "wz":
        return (yaw - at(yaw, window)) * -command.sign()
    heading = at(yaw, window)
    way = made.pos[..., :2] - at(made.pos[..., :2], window)
    return (way[..., 0] * heading.cos() + way[..., 1] * heading.sin()) * -command.sign()


_SPEED_HZ = 10.0  # power above this frequency is chatter: a body of this size moves at a few hertz


def effort(made: Trajectories, parts: RobotParts, settle_s: float) -> Columns:
    """Return torques and saturation of each actuator group, and the wheels' speed and sign changes; (N,) each.

    ``torque_rms_<group>`` is over joints and physics steps, N·m. ``torque_share_<group>`` is the same as a share of
    each joint's effort limit. ``saturation_<group>`` is the share of physics steps at the limit, and
    ``saturation_max_<group>`` that of the group's most saturated joint. ``wheel_sign_changes_per_s`` counts, per wheel,
    how often the torque crosses the whole dead band.
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
    """Return power, work, and cost of transport after settling; (N,) each.

    Gross sums ∑|τ q̇| Δt. Net sums ∑|(τ - I_a q̈) q̇| Δt, without the power that accelerates the armature. The cost of
    transport is energy / (m g d), with d the length of the path in the plane. It is NaN for robots with a zero command.
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
    """Return how much actions and torques change from step to step; (N,) each.

    ``action_rate_per_s`` is mean|Δa|/Δt and ``action_acceleration_per_s2`` mean|Δ²a|/Δt², over the action's components.
    ``torque_difference_rms_nm`` is the RMS change of torque per control step. ``fast_power_share`` is the share of the
    driven joints' torque power spectrum above 10 Hz, without its mean, for episodes that survived. Torques are sampled
    at the last physics step of each control step.
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
    """Return the share of the power of (T, N, J) above 10 Hz, (N,); NaN for episodes that ended early.

    The share of a constant signal is 0.
    """
    whole = counted[-1]
    begin = int(counted.any(dim=1).int().argmax()) if bool(counted.any()) else 0
    window = values[begin:].double()
    power = torch.fft.rfft(window - window.mean(dim=0), dim=0).abs().square().sum(dim=-1)
    frequency = torch.fft.rfftfreq(len(window), dt, device=values.device)
    share = power[frequency > _SPEED_HZ].sum(dim=0) / power.sum(dim=0).clamp(min=1e-12)
    return torch.where(whole, share, torch.nan)
