"""The ground of the scene.

| name | what it is |
|---|---|
| `TerrainBase` | the base class of every ground, also of a user's own |
| `Plane` | an infinite plane |
"""

from wheelleg_exp.sim.terrain.base import GROUND, GROUND_GROUP, TerrainBase, grid_origins, is_ground
from wheelleg_exp.sim.terrain.plane import Plane

__all__ = ["GROUND", "GROUND_GROUP", "Plane", "TerrainBase", "grid_origins", "is_ground"]
