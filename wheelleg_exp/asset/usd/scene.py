"""Finds the physics scene whose settings go for the robot, and reads gravity from it."""

from __future__ import annotations

import math

import numpy as np
from pxr import Usd, UsdPhysics

from wheelleg_exp.asset.description import Vec3
from wheelleg_exp.asset.geometry import single, vec3
from wheelleg_exp.asset.usd.stage import Stage


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


EARTH = 9.81


def gravity(stage: Stage) -> Vec3:
    """Return gravity in m/s², z up: of the robot's PhysicsScene wherever it is, else the earth's."""
    scene = scene_of_robot(stage)
    if scene is None:
        stage.ledger.assume(stage.source.name, "no PhysicsScene: gravity", f"{EARTH} m/s² downwards")
        return 0.0, 0.0, -EARTH
    for other in physics_scenes(stage):
        if other != scene:
            stage.ledger.leave(other.GetPath(), "PhysicsScene", f"one scene is read: {scene.GetPath()}")
    stage.ledger.mapped(scene.GetPath(), "PhysicsScene", "option gravity")
    if stage.ledger.read(scene, "newton:gravityEnabled", "option gravity") is False:
        stage.ledger.assume(scene.GetPath(), "newton:gravityEnabled is off", "no gravity")
        return 0.0, 0.0, 0.0
    return _vector(stage, scene)


def _vector(stage: Stage, scene: Usd.Prim) -> Vec3:
    size = stage.ledger.read(scene, "physics:gravityMagnitude", "option gravity")
    direction = stage.ledger.read(scene, "physics:gravityDirection", "option gravity")
    given = size is not None and size >= 0 and math.isfinite(size)
    metres = single(size * stage.units.meters) if given else EARTH
    if direction is None or not any(direction):
        return 0.0, 0.0, -metres
    turned = stage.units.world()[:3, :3] @ np.array(direction)
    return vec3(metres * turned / np.linalg.norm(turned))
