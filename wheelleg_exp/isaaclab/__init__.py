"""Isaac Lab's module paths, so that a term written for it needs another import line and nothing else.

``from isaaclab.managers import SceneEntityCfg`` becomes ``from wheelleg_exp.isaaclab.managers import SceneEntityCfg``.
The modules hand on what is elsewhere in this package; ``docs/isaaclab.md`` says what is the same and what is not.
"""
