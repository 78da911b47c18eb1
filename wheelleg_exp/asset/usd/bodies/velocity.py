"""Reads the saved velocity of bodies that float."""

from __future__ import annotations

import math

import numpy as np

from wheelleg_exp.asset.geometry import rigid_part, vec3
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link
from wheelleg_exp.asset.usd.stage import Stage

Velocity = tuple[float, float, float, float, float, float]


def velocity_of(stage: Stage, link: Link) -> Velocity:
    """Return a body's saved velocity: m/s in the world, then rad/s about the body's own axes.

    USD holds it in the space of the prim's transform, in stage lengths and degrees.
    """
    linear = stage.ledger.read(link.prim, "physics:velocity", "keyframe home, qvel")
    angular = stage.ledger.read(link.prim, "physics:angularVelocity", "keyframe home, qvel")
    space = rigid_part(stage.matrix(link.prim.GetParent())).rotation
    speed = space @ np.array(linear or (0.0, 0.0, 0.0)) * stage.units.meters
    turning = link.frame.rotation.T @ space @ np.array(angular or (0.0, 0.0, 0.0)) * (math.pi / 180)
    return *vec3(speed), *vec3(turning)
