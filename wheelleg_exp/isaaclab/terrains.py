"""What terms import of ``isaaclab.terrains``, for annotations: the ground, which is ``env.scene.terrain``."""

from wheelleg_exp.sim.terrain import TerrainBase

TerrainImporter = TerrainBase

__all__ = ["TerrainImporter"]
