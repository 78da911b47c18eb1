"""Driving from level ground over a strip of rough ground and on, on level ground: before, on and behind the strip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from wheelleg_exp.evaluation.measuring.on_terrain import along_heading
from wheelleg_exp.evaluation.measuring.standing import Columns
from wheelleg_exp.evaluation.options import Strip
from wheelleg_exp.evaluation.over_time import Trajectories, last_exit, mean, rms
from wheelleg_exp.evaluation.rollout import Rollout

_ROOM = 1.0  # m of level ground beyond what the commanded way needs, before and behind


def ground(options: Strip, terrain: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Return the node of the ground: a column for each strip, one row, and level ground around.

    Args:
        options: how rough the strips are, how long and wide.
        terrain: the node whose friction the ground has.
        seed: of the heights.
    """
    rim = options.horizontal_scale  # the tile's outer points are at height 0, so that the strip begins without a step
    noise = {"_target_": "wheelleg_exp.sim.terrain.UniformNoise", "proportion": 1.0, "border_width": rim}
    way = options.lin_vel_x * options.horizon_s
    return {
        "_target_": "wheelleg_exp.sim.terrain.TerrainGenerator",
        **{name: terrain[name] for name in ("static_friction", "dynamic_friction", "restitution")},
        "size": [options.length + 2 * rim, options.width],
        "num_rows": 1,
        "num_cols": len(options.amplitudes),
        "border_width": _ROOM + max(options.before, way - options.before - options.length),
        "horizontal_scale": options.horizontal_scale,
        "vertical_scale": options.vertical_scale,
        "curriculum": True,
        "difficulty_range": [1.0, 1.0],
        "seed": seed,
        "sub_terrains": {str(i): {**noise, "amplitude_range": [a, a]} for i, a in enumerate(options.amplitudes)},
    }


def place(rollout: Rollout, options: Strip) -> None:
    """Let every episode begin on the level ground before the strip of its cell."""
    env = rollout.env
    terrain, cell = env.scene.terrain, rollout.scenarios.cell_of().to(env.device)
    assert terrain.terrain_origins is not None  # the evaluation's ground has tiles
    terrain.terrain_types.copy_(cell)
    terrain.terrain_levels.zero_()
    begin = terrain.terrain_origins[0, cell].clone()
    begin[:, 0] -= options.before + options.length / 2
    begin[:, 2] = 0.0
    terrain.env_origins.copy_(begin)


@dataclass(frozen=True)
class Phases:
    """Which steps of an episode are where; a robot that comes back over an edge changes nothing.

    Attributes:
        before: the last ``quiet_s`` seconds before the strip, of who comes to it, (T, N) bool.
        on: from then on, until it has left the strip, (T, N) bool.
        behind: from then on, (T, N) bool.
    """

    before: torch.Tensor
    on: torch.Tensor
    behind: torch.Tensor


def phases(made: Trajectories, options: Strip, settle_s: float) -> Phases:
    """Return which steps are before, on and behind the strip, by where the root link is along x."""
    x, alive = made.pos[..., 0], made.alive
    come = (alive & (x >= options.before)).cummax(dim=0).values
    gone = (alive & (x > options.before + options.length)).cummax(dim=0).values
    steps = torch.arange(made.steps, device=x.device).unsqueeze(1)
    entry = torch.where(come.any(dim=0), come.int().argmax(dim=0), 0)
    last = steps >= entry - round(options.quiet_s / made.dt)
    return Phases(made.counted(settle_s) & ~come & last & come.any(dim=0), alive & come & ~gone, alive & gone)


def crossing(made: Trajectories, options: Strip, settle_s: float) -> Columns:
    """Return how each robot comes over the strip; (N,) each, NaN where it never was there.

    ``distance_ratio`` and ``success`` are as of ``on_terrain.ways``; ``error_vx_<where>`` and ``swing_rad_<where>`` are
    RMS values before, on and behind the strip, of v_x - c and of the pitch about its own mean before: the task's wrench
    makes each robot lean otherwise. ``recovery_s`` is the time after the strip from which on the pitch is as quiet as
    before: its swing over the coming ``recovered_s`` seconds is at most ``quiet_factor`` times that before, or
    ``quiet_floor``. ``recovered`` is 1 where it is at most ``within_s``
    and the episode lived, else 0.
    """
    found = phases(made, options, settle_s)
    ratio = along_heading(made) / (options.lin_vel_x * options.horizon_s)
    columns: Columns = {
        "distance_ratio": ratio,
        "success": (~made.fell & (ratio >= options.distance_share)).double(),
    }
    pitch = made.pitch.double()
    swing = pitch - mean(pitch, found.before)
    error = made.vel[..., 0] - made.command[..., 0]
    for name, counted in (("before", found.before), ("on", found.on), ("behind", found.behind)):
        columns[f"error_vx_{name}"] = rms(error, counted)
        columns[f"swing_rad_{name}"] = rms(swing, counted)
    return columns | _recovery(made, swing, found, options)


def _recovery(made: Trajectories, swing: torch.Tensor, found: Phases, options: Strip) -> Columns:
    limit = (options.quiet_factor * rms(swing, found.before)).clamp(min=options.quiet_floor)
    window = max(1, round(options.recovered_s / made.dt))
    sums = torch.cat((torch.zeros_like(swing[:1]), swing.square().cumsum(dim=0)))
    coming = torch.full_like(swing, torch.nan)
    coming[: made.steps - window + 1] = ((sums[window:] - sums[:-window]) / window).clamp(min=0.0).sqrt()
    known = found.behind & ~coming.isnan()
    time = last_exit(coming > limit, known, made.dt)
    long_enough = found.behind.sum(dim=0) >= round((options.within_s + options.recovered_s) / made.dt)
    time = torch.where(made.fell | limit.isnan() | ~long_enough, torch.nan, time)
    return {"recovery_s": time, "recovered": (time <= options.within_s).double()}
