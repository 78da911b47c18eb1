"""Finds the physics scenes of a stage, and the one whose settings go for the robot."""

from __future__ import annotations

from pxr import Usd, UsdPhysics

from wheelleg_exp.asset.reader.stage import Stage


def physics_scenes(stage: Stage) -> list[Usd.Prim]:
    """Return all PhysicsScene prims of a stage, wherever they are."""
    cache = vars(stage)  # to go through a large stage once
    if "physics_scenes" not in cache:
        cache["physics_scenes"] = [prim for prim in stage.usd.Traverse() if prim.IsA(UsdPhysics.Scene)]
    found: list[Usd.Prim] = cache["physics_scenes"]
    return found


def scene_of_robot(stage: Stage) -> Usd.Prim | None:
    """Return the scene that the bodies name as their owner, else the first one; None when there is none."""
    scenes = physics_scenes(stage)
    if len(scenes) < 2:
        return scenes[0] if scenes else None
    paths = {scene.GetPath(): scene for scene in scenes}
    for prim in stage.prims:
        for target in stage.ledger.targets(prim, "physics:simulationOwner"):
            if target in paths:
                stage.ledger.mapped(prim.GetPath(), "physics:simulationOwner", "the choice of the scene")
                return paths[target]
    return scenes[0]
