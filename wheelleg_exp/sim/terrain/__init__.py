"""The ground of the scene.

| name | what it is |
|---|---|
| `TerrainBase` | the base class of every ground, including user-defined ones |
| `Plane` | an infinite plane |
| `TerrainGenerator` | tiles, generated, harder from row to row |
| `HeightField`, `Mesh` | a user's file |
| `SubTerrain`, `Grid` | the base class of kinds of tiles, and the points of their heights |
| `Flat`, `RandomUniform`, `UniformNoise`, `PyramidSlope`, `Waves` | level, rough and sloped tiles |
| `PyramidStairs`, `RandomGrid`, `DiscreteObstacles`, `SteppingStones`, `Gap`, `Rails`, `Box` | tiles with steps |
| `FlatPatches` | level patches on which an episode can start, or to which a command can lead |
"""

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
from wheelleg_exp.sim.terrain.terrain_generator import TerrainGenerator
