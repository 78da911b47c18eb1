import math

import pytest
import torch
from sim.terrain.tiles import OPTIONS, TERRAIN

from .worlds import STONE, placed, term, watch

SENSORS = "wheelleg_exp.sim.sensors."
HALF, CELL = 2.0, 0.05  # half of the tile's edge and the edge of a cell, m
ANGLE, TOP = 0.2, 0.8  # rad, m

SLOPE = {"_target_": TERRAIN + "PyramidSlope", "slope_range": [ANGLE, ANGLE], "platform_width": TOP}


def _world(world, kind, pose):
    ground = {**OPTIONS, "_target_": TERRAIN + "TerrainGenerator", "size": [2 * HALF, 2 * HALF], "num_rows": 1}
    ground |= {"num_cols": 1, "horizontal_scale": CELL, "vertical_scale": 1e-5, "seed": 3, "origin_window": 0.05}
    ground["sub_terrains"] = {"one": {"proportion": 1.0, **kind}}
    pattern = {"_target_": SENSORS + "GridPattern", "resolution": 0.09, "size": [1.8, 1.08]}
    caster = {"_target_": SENSORS + "RayCaster", "body_name": "stone", "pattern": pattern, "ray_alignment": "yaw"}
    caster["offset"] = {"pos": [0.0, 0.0, 5.0]}
    chosen = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "eyes"}
    scan = term("observations", "height_scan", sensor_cfg=chosen, offset=0.25)
    return world(
        STONE,
        0.01,
        sim={"gravity": [0.0, 0.0, 0.0]},
        scene={"terrain": ground, "sensors": {"eyes": caster}},
        observations={"seen": {"concatenate_terms": False, "terms": {"scan": scan}}},
        events={"place": placed(pose)},
    )


def _places(pose):
    x = -0.9 + 0.09 * torch.arange(21, dtype=torch.float64)
    y = -0.54 + 0.09 * torch.arange(13, dtype=torch.float64)
    y, x = torch.meshgrid(y, x, indexing="ij")
    cos, sin = math.cos(pose["yaw"]), math.sin(pose["yaw"])
    return pose["x"] + (cos * x - sin * y).flatten(), pose["y"] + (sin * x + cos * y).flatten()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_scan_of_a_slope_is_its_plane_faces_and_top(world, sign):
    kind, pose = SLOPE | {"inverted": sign < 0}, {"x": 0.93, "y": -0.37, "z": 0.7, "yaw": 0.4, "pitch": 0.3}
    x, y = _places(pose)
    top = sign * math.tan(ANGLE) * (HALF - TOP / 2)
    ground = top + pose["z"] - 0.25 - watch(_world(world, kind, pose), 1)["scan"][1, 0]
    inwards = HALF - torch.maximum(x.abs(), y.abs())
    expected = sign * math.tan(ANGLE) * inwards.clamp(max=HALF - TOP / 2)
    # In a cell on an edge of the pyramid, the height differs from the formula by at most the rise over one cell.
    outermost = torch.maximum(x.abs(), y.abs())
    crossed = ((x.abs() - y.abs()).abs() < CELL) | ((outermost - TOP / 2).abs() < CELL)
    torch.testing.assert_close(ground[~crossed], expected[~crossed], atol=2e-5, rtol=0)
    torch.testing.assert_close(ground, expected, atol=math.tan(ANGLE) * CELL, rtol=0)
    assert (~crossed).sum() > 180
    assert expected.max() - expected.min() > 0.15
