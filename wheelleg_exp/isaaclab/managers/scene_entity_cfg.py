"""Members of the scene, as terms take them."""

from wheelleg_exp.managers import SceneEntityCfg

__all__ = ["SceneEntityCfg"]
