"""Driving straight on over tiles of rough ground: each episode on one tile, whose kind and level it has."""

from __future__ import annotations

import copy
from typing import Any

import torch

from wheelleg_exp.evaluation.measuring.standing import Columns
from wheelleg_exp.evaluation.options import Terrain
from wheelleg_exp.evaluation.over_time import Trajectories
from wheelleg_exp.evaluation.rollout import Rollout
from wheelleg_exp.sim.terrain.generator import ORIGIN_WINDOW

_BORDER = 2.0  # m of level ground around all tiles, so that no edge is near


def tiles(options: Terrain, seed: int) -> dict[str, Any]:
    """Return the node of the ground: a column for each kind of tile, a row for each level.

    Args:
        options: which kinds, how many levels, how large.
        seed: of all chance in the ground.
    """
    terrain = copy.deepcopy(options.scene["terrain"])
    kinds = {name: node for name, node in terrain["sub_terrains"].items() if node is not None}
    for node in kinds.values():
        node["proportion"] = 1.0
    # The window in which robots begin stays as wide in m: the floor of a pit does not grow with its tile.
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


def place(rollout: Rollout, options: Terrain) -> None:
    """Let every episode begin on the tile of its cell."""
    env = rollout.env
    ground, cell = env.scene.terrain, rollout.scenarios.cell_of().to(env.device)
    assert ground.terrain_origins is not None  # the evaluation's ground has tiles
    ground.terrain_types.copy_(cell // options.levels)
    ground.terrain_levels.copy_(cell % options.levels)
    ground.env_origins.copy_(ground.terrain_origins[ground.terrain_levels, ground.terrain_types])


def ways(made: Trajectories, rollout: Rollout, options: Terrain) -> Columns:
    """Return how far each robot came, and whether that is a success; (N,) each.

    ``distance_ratio`` is the way from the start along the first heading, at the last step that the episode lived, as a
    share of the commanded speed times the horizon. ``success`` is 1 where the episode lived and the ratio is at least
    ``distance_share``, else 0. ``kind`` and ``level`` say which tile.
    """
    cell = rollout.scenarios.cell_of().to(made.alive.device)
    ratio = along_heading(made) / (options.lin_vel_x * options.horizon_s)
    return {
        "kind": (cell // options.levels).double(),
        "level": (cell % options.levels).double(),
        "distance_ratio": ratio,
        "success": (~made.fell & (ratio >= options.distance_share)).double(),
    }


def along_heading(made: Trajectories) -> torch.Tensor:
    """Return how far each robot came along its first heading, m, (N,), at the last step that the episode lived."""
    last = (made.alive.sum(dim=0) - 1).clamp(min=0)
    there = made.pos[last, torch.arange(made.pos.shape[1], device=last.device), :2]
    way = (there - made.pos[0, :, :2]).double()
    heading = made.yaw[0].double()
    return way[:, 0] * heading.cos() + way[:, 1] * heading.sin()
