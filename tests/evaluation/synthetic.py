"""Build trajectories of synthetic episodes."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from wheelleg_exp.evaluation.evaluation_env import RobotParts
from wheelleg_exp.evaluation.trajectories import Trajectories

DT = 1 / 60


def parts(n: int = 1) -> RobotParts:
    """Return a robot of 0.5 kg with two legs of one joint, and two wheels with a track of 0.2 m."""
    index = torch.tensor
    return RobotParts(
        joint_names=("hip_a", "hip_b", "roll_a", "roll_b"), wheels=index([2, 3]), contacts="contacts",
        wheel_bodies=index([0, 1]), wheel_links=index([[0], [1]]), wheel_radius=index([0.02, 0.02]),
        wheel_offsets=index([0.1, -0.1]), left=index([0]), right=index([1]),
        sign=index([-1.0]), groups={"hips": index([0, 1]), "wheels": index([2, 3])}, mass=0.5, gravity=9.81,
        effort_limit=index([[2.0, 2.0, 10.0, 10.0]]).expand(n, 4),
    )  # fmt: skip


def still(seconds: float, n: int = 1) -> Trajectories:
    """Return episodes of robots that stand still and survive."""
    env = SimpleNamespace(step_dt=DT, device="cpu")
    made = Trajectories.empty(round(seconds / DT), n, parts(n), 4, env)
    made.alive[:], made.down[:] = True, True
    return made


def times(made: Trajectories) -> torch.Tensor:
    """Return the time at the end of each step, s, (T,)."""
    return torch.arange(1, made.steps + 1) * DT


def fall(made: Trajectories, episode: int, at_s: float) -> None:
    """Make an episode fail at the time ``at_s``."""
    step = round(at_s / DT)
    made.fell_at[episode] = step
    made.alive[step - 1 :, episode] = False
