"""Responses to steps of the command: from standing to driving, to driving the other way, to standing."""

from __future__ import annotations

import torch

from wheelleg_exp.evaluation.measuring.standing import Columns
from wheelleg_exp.evaluation.options import Steps
from wheelleg_exp.evaluation.over_time import Trajectories, at, largest, last_exit


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
