"""The ground of the scene: a plane, generated tiles, files, and the base classes of user-defined grounds."""

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
    combined_friction,
    grid_origins,
    is_ground,
)
from wheelleg_exp.sim.terrain.terrain_files import HeightField, Mesh
from wheelleg_exp.sim.terrain.terrain_generator import TerrainGenerator
