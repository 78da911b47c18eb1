"""How well velocity commands are followed: columns of the walking grid."""

from __future__ import annotations

import torch

from wheelleg_exp.evaluation.measuring.standing import Columns
from wheelleg_exp.evaluation.options import Walk
from wheelleg_exp.evaluation.over_time import Trajectories, mean, rms
from wheelleg_exp.evaluation.robot_parts import RobotParts


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
