"""What the motors bear: torque, saturation, energy; and how much a policy chatters."""

from __future__ import annotations

import torch

from wheelleg_exp.evaluation.measuring.standing import Columns
from wheelleg_exp.evaluation.over_time import Trajectories, largest, mean, rms, total
from wheelleg_exp.evaluation.robot_parts import RobotParts

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
