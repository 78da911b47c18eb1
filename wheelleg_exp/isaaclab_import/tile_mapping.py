"""Convert the terrain generator of Isaac Lab's ``env.yaml`` and its tiles, the sub-terrains."""

from __future__ import annotations

import math
from collections.abc import Sequence

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab_import.import_report import DROPPED, NAME, RULE, ImportReport, Section
from wheelleg_exp.isaaclab_import.term_mapping import last_name, parameters_of
from wheelleg_exp.jobs.export.isaaclab_run import INVERTED, PIT_NAMES, TILES, Tree

# Keys of a generator that do not change the simulation.
_GENERATOR_UNUSED = ("class_type", "color_scheme", "use_cache", "cache_dir")
# How tiles that follow a rule of this project differ from Isaac Lab's.
_TILE_RULES = {
    "Gap": "the gap is 1 m deep; in Isaac Lab, it has no bottom",
    "PyramidSlope": "faces have one slope; in Isaac Lab, the slope decreases from the middle of a face to its corners",
    "Rails": "edges are rounded to horizontal_scale, and the outer rail is always a square; in Isaac Lab, neither",
    "RandomGrid": "edges are slopes, and the middle has the height 0; in Isaac Lab, the largest possible height",
    "SteppingStones": "stones and holes have the given widths; in Isaac Lab, these are rounded to horizontal_scale",
}


def convert_generator(part: Section, report: ImportReport) -> Tree:
    """Return the node of a terrain generator with those of its tiles that exist here."""
    tiles = part.section("sub_terrains")
    node: Tree = {"_target_": "wheelleg_exp.sim.terrain.TerrainGenerator", "num_rows": 1, "num_cols": 1}
    node |= {"border_width": 0.0, "difficulty_range": [0.0, 1.0], "curriculum": False}
    node |= {"horizontal_scale": 0.1, "vertical_scale": 0.005}
    node |= part.take_if_known(parameters_of(node["_target_"], part.key))
    made = {name: _tile(tile, node["size"], node["horizontal_scale"], report) for name, tile in tiles.sections()}
    node["sub_terrains"] = {name: tile for name, tile in made.items() if tile is not None}
    if not node["sub_terrains"]:
        raise ConfigError("none of the tiles exists here", key=tiles.key, expected=", ".join(TILES))
    part.drop(["slope_threshold"], "tiles of boxes have vertical edges, other tiles have slopes")
    part.drop(["border_height"], "the border ends at the level of the ground")
    part.finish(skip=_GENERATOR_UNUSED)
    return node


def _tile(part: Section, size: Sequence[float], scale: float, report: ImportReport) -> Tree | None:
    source = str(part.take("function"))
    function = last_name(source)
    if function not in TILES:
        report.add(part.key, DROPPED, f"'{function}' does not exist here; the shares of the other tiles grow")
        return None
    kind = TILES[function]
    node: Tree = {"_target_": f"wheelleg_exp.sim.terrain.{kind}"}
    node |= {"inverted": True} if function in INVERTED else {}
    renamed = PIT_NAMES | {"flat_patch_sampling": "flat_patches"}
    node |= {renamed[name]: value for name, value in part.take_if_known(renamed).items()}
    if kind == "PyramidSlope":
        low, high = part.take("slope_range")
        node["slope_range"] = [math.atan(low), math.atan(high)]
        text = f"[{low}, {high}] (rise over run) became radians, also between them"
        report.add(f"{part.key}.slope_range", RULE, text)
    node |= part.take_if_known(parameters_of(node["_target_"], part.key))
    rule = _TILE_RULES.get(kind)
    if kind == "Gap":
        node["gap_depth"] = 1.0
    if kind == "PyramidStairs" and "mesh_terrains" in source:
        # Isaac Lab's stairs start with a step at the border, and have as many steps as fit.
        width, border = node["step_width"], node.get("border_width", 0.0)
        inner = min(size) - 2 * border
        steps = (inner - node["platform_width"]) // (2 * width) + 1
        node["platform_width"] = round(max(0.0, inner - (2 * steps - 1) * width), 9)
        lower = "a step lower than in Isaac Lab (inverted: higher), because"
        rule = f"the stairs are {lower} the border is narrower than a step"
        if border >= width:
            node["border_width"] = round(border - width, 9)
            rule = "other border_width and platform_width, but the same heights"
        if 2 * steps * width > inner + 1e-9:
            rule += f"; the middle is at least {lower} the last step does not fit"
        if any(abs(math.remainder(length, scale)) > 1e-6 for length in (width, border)):
            rule += "; edges are rounded to horizontal_scale"
    report.add(part.key, NAME if rule is None else RULE, kind if rule is None else f"{kind}: {rule}")
    part.drop(["slope_threshold"], "the tile has slopes")
    part.finish(skip=("size", "vertical_scale", "convert_to_heightfield"))
    return node
