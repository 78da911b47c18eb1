"""Tests on rough ground: on one tile (``terrain``), or from level ground over a strip to level ground (``strip``)."""

from __future__ import annotations

import copy

import torch

from wheelleg_exp.constraints import Node
from wheelleg_exp.evaluation.evaluation_env import FRICTION
from wheelleg_exp.evaluation.motion_columns import Columns
from wheelleg_exp.evaluation.policy_rollout import Rollout
from wheelleg_exp.evaluation.protocol_options import Strip, Terrain
from wheelleg_exp.evaluation.trajectories import Trajectories, last_exit, mean, rms
from wheelleg_exp.sim.terrain.terrain_generator import ORIGIN_WINDOW

_BORDER = 2.0  # level ground, m


def tiles(options: Terrain, seed: int) -> Node:
    """Return a terrain config with one column per kind of terrain tile and one row per difficulty level."""
    terrain = copy.deepcopy(options.scene["terrain"])
    kinds = {name: node for name, node in terrain["sub_terrains"].items() if node is not None}
    for node in kinds.values():
        node["proportion"] = 1.0
    # On a larger tile, a pit's floor keeps its width, so reduce ``origin_window``, a share of the tile's width.
    wider = min(now / own for now, own in zip(options.size, terrain["size"], strict=True))
    return {
        **terrain,
        "size": list(options.size),
        "origin_window": min(1.0, terrain.get("origin_window", ORIGIN_WINDOW) / wider),
        "num_rows": options.levels,
        "num_cols": len(kinds),
        "curriculum": True,
        "difficulty_range": [0.0, 1.0],
        "max_init_terrain_level": None,
        "border_width": max(_BORDER, float(terrain.get("border_width", 0.0))),
        "seed": seed,
        "sub_terrains": kinds,
    }


def place_on_tiles(rollout: Rollout, options: Terrain) -> None:
    """Place each robot on the terrain tile of its scenario."""
    env = rollout.env
    ground, cell = env.scene.terrain, rollout.scenarios.cell_of().to(env.device)
    assert ground.terrain_origins is not None
    ground.terrain_types.copy_(cell // options.levels)
    ground.terrain_levels.copy_(cell % options.levels)
    ground.env_origins.copy_(ground.terrain_origins[ground.terrain_levels, ground.terrain_types])


def ways(made: Trajectories, rollout: Rollout, options: Terrain) -> Columns:
    """Return each robot's driven distance, its success, and the kind and level of its terrain tile, (N,) each.

    ``distance_ratio`` is the distance along the first heading before a failure, over the commanded distance.
    ``success`` is 1 if the robot did not fall and ``distance_ratio`` is at least ``distance_share``, else 0.
    """
    cell = rollout.scenarios.cell_of().to(made.alive.device)
    tile = {"kind": (cell // options.levels).double(), "level": (cell % options.levels).double()}
    return tile | _success(made, options)


def _success(made: Trajectories, options: Terrain | Strip) -> Columns:
    last = (made.alive.sum(dim=0) - 1).clamp(min=0)
    way = (made.pos[last, torch.arange(made.pos.shape[1], device=last.device), :2] - made.pos[0, :, :2]).double()
    heading = made.yaw[0].double()
    driven = way[:, 0] * heading.cos() + way[:, 1] * heading.sin()
    ratio = driven / (options.lin_vel_x * options.horizon_s)
    return {"distance_ratio": ratio, "success": (~made.fell & (ratio >= options.distance_share)).double()}


_STRIP_ROOM = 1.0  # level ground, m


def strip_ground(options: Strip, terrain: Node, seed: int) -> Node:
    """Return a terrain config with one strip of rough ground per column, in level ground of the task's friction."""
    # The outermost points of a rough strip have height 0, so that the strip has no step to the level ground.
    rim = options.horizontal_scale
    noise = {"_target_": "wheelleg_exp.sim.terrain.UniformNoise", "proportion": 1.0, "border_width": rim}
    way = options.lin_vel_x * options.horizon_s
    return {
        "_target_": "wheelleg_exp.sim.terrain.TerrainGenerator",
        **{name: terrain[name] for name in FRICTION},
        "size": [options.length + 2 * rim, options.width],
        "num_rows": 1,
        "num_cols": len(options.amplitudes),
        "border_width": _STRIP_ROOM + max(options.before, way - options.before - options.length),
        "horizontal_scale": options.horizontal_scale,
        "vertical_scale": options.vertical_scale,
        "curriculum": True,
        "difficulty_range": [1.0, 1.0],
        "seed": seed,
        "sub_terrains": {str(i): {**noise, "amplitude_range": [a, a]} for i, a in enumerate(options.amplitudes)},
    }


def place_before_strip(rollout: Rollout, options: Strip) -> None:
    """Place every robot on the level ground before the rough strip of its scenario."""
    env = rollout.env
    terrain, cell = env.scene.terrain, rollout.scenarios.cell_of().to(env.device)
    assert terrain.terrain_origins is not None
    terrain.terrain_types.copy_(cell)
    terrain.terrain_levels.zero_()
    begin = terrain.terrain_origins[0, cell].clone()
    begin[:, 0] -= options.before + options.length / 2
    begin[:, 2] = 0.0
    terrain.env_origins.copy_(begin)


def phases(made: Trajectories, options: Strip, settle_s: float) -> dict[str, torch.Tensor]:
    """Return masks (T, N) of the control steps in which each robot is ``before``, ``on``, and ``behind`` rough ground.

    A robot that rolls back still counts as on or behind it. ``before`` covers the last ``quiet_s`` seconds before it.
    """
    x, alive = made.pos[..., 0], made.alive
    come = (alive & (x >= options.before)).cummax(dim=0).values
    gone = (alive & (x > options.before + options.length)).cummax(dim=0).values
    steps = torch.arange(made.steps, device=x.device).unsqueeze(1)
    entry = torch.where(come.any(dim=0), come.int().argmax(dim=0), 0)
    last = steps >= entry - round(options.quiet_s / made.dt)
    before = made.counted(settle_s) & ~come & last & come.any(dim=0)
    return {"before": before, "on": alive & come & ~gone, "behind": alive & gone}


def crossing(made: Trajectories, options: Strip, settle_s: float) -> Columns:
    """Return columns (N,) on how each robot crosses a strip of rough ground; NaN for a robot that does not reach it.

    ``distance_ratio`` and ``success`` are those of ``ways``. ``error_vx_before``, ``_on``, and ``_behind`` are RMS
    errors of the forward speed; ``swing_rad_before``, ``_on``, and ``_behind`` are RMS deviations of the pitch from its
    mean before the strip. ``recovery_s`` is the time from the end of the strip until the pitch is quiet: for
    ``recovered_s`` seconds, its RMS deviation is at most ``max(quiet_floor, quiet_factor * swing_rad_before)``.
    ``recovered`` is 1 if the robot did not fall and ``recovery_s`` is at most ``within_s``, else 0.
    """
    found = phases(made, options, settle_s)
    columns = _success(made, options)
    pitch = made.pitch.double()
    swing = pitch - mean(pitch, found["before"])
    error = made.vel[..., 0] - made.command[..., 0]
    for name, counted in found.items():
        columns[f"error_vx_{name}"] = rms(error, counted)
        columns[f"swing_rad_{name}"] = rms(swing, counted)
    limit = (options.quiet_factor * rms(swing, found["before"])).clamp(min=options.quiet_floor)
    window = max(1, round(options.recovered_s / made.dt))
    # The difference of two cumulative sums of squares is the sum of squares over one sliding window.
    sums = torch.cat((torch.zeros_like(swing[:1]), swing.square().cumsum(dim=0)))
    coming = torch.full_like(swing, torch.nan)
    coming[: made.steps - window + 1] = ((sums[window:] - sums[:-window]) / window).clamp(min=0.0).sqrt()
    known = found["behind"] & ~coming.isnan()
    time = last_exit(coming > limit, known, made.dt)
    long_enough = found["behind"].sum(dim=0) >= round((options.within_s + options.recovered_s) / made.dt)
    time = torch.where(made.fell | limit.isnan() | ~long_enough, torch.nan, time)
    return columns | {"recovery_s": time, "recovered": (time <= options.within_s).double()}
