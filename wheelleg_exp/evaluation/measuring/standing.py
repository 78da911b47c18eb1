"""How still and how upright: columns of every test, and those of standing alone."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from wheelleg_exp.evaluation.over_time import Trajectories, at, largest, mean, rms, slope
from wheelleg_exp.evaluation.robot_parts import RobotParts

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
