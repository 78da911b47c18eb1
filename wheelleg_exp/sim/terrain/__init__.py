"""The ground of the scene.

| name | what it is |
|---|---|
| `TerrainBase` | the base class of every ground, also of a user's own |
| `Plane` | an infinite plane |
| `TerrainGenerator` | tiles, generated, harder from row to row |
| `HeightField`, `Mesh` | a user's own file |
| `SubTerrain`, `Grid` | a kind of tile, also a user's own, and where it is asked for its heights |
| `Flat`, `RandomUniform`, `UniformNoise`, `PyramidSlope`, `Waves` | level, rough and sloped tiles |
| `PyramidStairs`, `RandomGrid`, `DiscreteObstacles`, `SteppingStones`, `Gap`, `Rails`, `Box` | with steps |
| `FlatPatches` | level places to begin or to end on |
"""

from wheelleg_exp.sim.terrain.generator import TerrainGenerator
from wheelleg_exp.sim.terrain.sub_terrains import (
    Box,
    DiscreteObstacles,
    Flat,
    FlatPatches,
    Gap,
    Grid,
    PyramidSlope,
    PyramidStairs,
    Rails,
    RandomGrid,
    RandomUniform,
    SteppingStones,
    SubTerrain,
    UniformNoise,
    Waves,
)
from wheelleg_exp.sim.terrain.terrain_base import (
    GROUND,
    GROUND_GROUP,
    TERRAIN_KEY,
    Plane,
    TerrainBase,
    grid_origins,
    is_ground,
)
from wheelleg_exp.sim.terrain.terrain_files import HeightField, Mesh

__all__ = [
    "GROUND",
    "GROUND_GROUP",
    "TERRAIN_KEY",
    "Box",
    "DiscreteObstacles",
    "Flat",
    "FlatPatches",
    "Gap",
    "Grid",
    "HeightField",
    "Mesh",
    "Plane",
    "PyramidSlope",
    "PyramidStairs",
    "Rails",
    "RandomGrid",
    "RandomUniform",
    "SteppingStones",
    "SubTerrain",
    "TerrainBase",
    "TerrainGenerator",
    "UniformNoise",
    "Waves",
    "grid_origins",
    "is_ground",
]
