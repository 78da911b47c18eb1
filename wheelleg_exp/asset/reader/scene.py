"""Reads gravity, self-collision, and the pairs that never touch."""

from __future__ import annotations

import math

import numpy as np
from pxr import Sdf, Usd, UsdPhysics

from wheelleg_exp.asset.description import Vec3
from wheelleg_exp.asset.geometry import single, vec3
from wheelleg_exp.asset.reader.bodies import Links
from wheelleg_exp.asset.reader.joints import Joint
from wheelleg_exp.asset.reader.stage import Stage

EARTH = 9.81


def gravity(stage: Stage) -> Vec3:
    """Return gravity in m/s², z up: of the file's first PhysicsScene wherever it is, else the earth's."""
    scenes = [p for p in Usd.PrimRange(stage.usd.GetPseudoRoot()) if p.IsA(UsdPhysics.Scene)]
    if not scenes:
        stage.ledger.assume(stage.source.name, "no PhysicsScene: gravity", f"{EARTH} m/s² downwards")
        return 0.0, 0.0, -EARTH
    for other in scenes[1:]:
        stage.ledger.leave(other.GetPath(), "PhysicsScene", "one scene is read, the first")
    scene = scenes[0]
    stage.ledger.mapped(scene.GetPath(), "PhysicsScene", "option gravity")
    size = stage.ledger.read(scene, "physics:gravityMagnitude", "option gravity")
    direction = stage.ledger.read(scene, "physics:gravityDirection", "option gravity")
    given = size is not None and size >= 0 and math.isfinite(size)
    metres = single(size * stage.units.meters) if given else EARTH
    if direction is None or not any(direction):
        return 0.0, 0.0, -metres
    turned = stage.units.world()[:3, :3] @ np.array(direction)
    return vec3(metres * turned / np.linalg.norm(turned))


def self_collision(stage: Stage) -> bool:
    """Return whether the robot's own bodies may touch; on unless a root says otherwise."""
    values = []
    for prim in stage.prims:
        for name in ("physxArticulation:enabledSelfCollisions", "newton:selfCollisionEnabled"):
            value = stage.ledger.read(prim, name, "contype and conaffinity of the colliders")
            if value is not None:
                values.append(bool(value))
    return all(values)


def exclusions(stage: Stage, links: Links, joints: list[Joint]) -> list[tuple[str, str]]:
    """Return pairs of body names that never touch: joined without collisionEnabled, or filtered."""
    pairs: dict[tuple[str, str], None] = {}
    for joint in joints:
        first, second = joint.links
        if first and second and not joint.may_collide:
            pairs[_ordered(links, first.name, second.name)] = None
    for prim in stage.prims:
        targets = stage.ledger.targets(prim, "physics:filteredPairs", "contact exclude")
        for a in _around(links, prim.GetPath()):
            for target in targets:
                for b in _around(links, target):
                    if a != b:
                        pairs[_ordered(links, a, b)] = None
    for prim in stage.prims:
        if prim.IsA(UsdPhysics.CollisionGroup):
            _leave_group(stage, prim)
    return list(pairs)


def _ordered(links: Links, a: str, b: str) -> tuple[str, str]:
    order = [link.name for link in links]
    return (a, b) if order.index(a) <= order.index(b) else (b, a)


def _around(links: Links, path: Sdf.Path) -> list[str]:
    """Return the names of the bodies meant by a path: the one at or above it, else all below."""
    owner = links.owner(path)
    return [owner.name] if owner else [link.name for link in links.below(path)]


def _leave_group(stage: Stage, prim: Usd.Prim) -> None:
    filtered = stage.ledger.targets(prim, "physics:filteredGroups")
    stage.ledger.leave(prim.GetPath(), "PhysicsCollisionGroup", "collision groups are not supported", filtered)
    if filtered:
        stage.ledger.warn(f"{prim.GetPath()}: the pairs of this collision group may touch in the model")
