"""Find the rigid bodies of a USD stage, the body of each prim, and the saved velocities of floating bodies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd

from wheelleg_exp.asset.file_limits import MOST_BODIES, require_size
from wheelleg_exp.asset.rigid_geometry import Frame, rigid_part, vec3
from wheelleg_exp.asset.robot_description import unique_names
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas, variant_sets
from wheelleg_exp.errors import AssetError

LONGEST = 200  # characters per name


@dataclass(eq=False)
class Link:
    """A rigid body as drawn: its prim, name, and frame in the world."""

    path: str
    prim: Usd.Prim
    name: str
    frame: Frame
    kinematic: bool
    weightless: bool


class Links:
    """All rigid bodies of a stage, by path, in the order of the stage."""

    def __init__(self, links: list[Link]) -> None:
        self.by_path = {link.path: link for link in links}
        self._owners: dict[Sdf.Path, Link | None] = {
            Sdf.Path.absoluteRootPath: None,
            **{Sdf.Path(link.path): link for link in links},
        }

    def __iter__(self) -> Iterator[Link]:
        return iter(self.by_path.values())

    def owner(self, path: Sdf.Path) -> Link | None:
        """Return the rigid body at or above a prim path; None if the prim belongs to no rigid body."""
        climbed = []
        while path not in self._owners and not path.isEmpty:
            climbed.append(path)
            path = path.GetParentPath()
        found = self._owners.get(path)
        self._owners.update(dict.fromkeys(climbed, found))
        return found

    def below(self, path: Sdf.Path) -> list[Link]:
        """Return the rigid bodies at or below the prim path ``path``."""
        return [link for link in self.by_path.values() if Sdf.Path(link.path).HasPrefix(path)]


def find_links(stage: Stage) -> Links:
    """Return the enabled rigid bodies."""
    prims = [prim for prim in stage.prims if "PhysicsRigidBodyAPI" in schemas(prim) and _enabled(stage, prim)]
    if not prims:
        raise _no_articulation(stage)
    require_size(len(prims), MOST_BODIES, "rigid bodies", where=str(stage.source))
    return Links([_link(stage, prim, name) for prim, name in named(prims)])


def _no_articulation(stage: Stage) -> AssetError:
    name, missing = stage.source.name, ", ".join(stage.unresolved)
    if missing:
        return AssetError(
            f"'{name}' has no articulation, and layers that it names are missing: {missing}",
            where=str(stage.source),
            expected="those layers next to the file, and PhysicsRigidBodyAPI on prims below the default prim",
        )
    return AssetError(
        f"'{name}' has no articulation: no prim carries PhysicsRigidBodyAPI{_why_nothing(stage)}",
        where=str(stage.source),
        expected="rigid bodies below the default prim; " + _what_to_choose(stage),
    )


def _why_nothing(stage: Stage) -> str:
    root = stage.root
    if not root.IsActive():
        return f", and {root.GetPath()} is switched off (active = false)"
    if root.IsAbstract():
        return f", and {root.GetPath()} is a class, which has no effect until it is referenced"
    if not root.IsDefined():
        return f", and {root.GetPath()} is an 'over' without a definition"
    elsewhere = [prim for prim in stage.usd.Traverse() if "PhysicsRigidBodyAPI" in schemas(prim)]
    return f" there; outside of {root.GetPath()} there is {elsewhere[0].GetPath()}" if elsewhere else ""


def _what_to_choose(stage: Stage) -> str:
    sets = variant_sets(stage.root)
    if not sets:
        return "the file has no variants to choose from"
    choices = "; ".join(f"{name}: {', '.join(options)}" for name, options in sets.items())
    return f"or another variant, by --variant SET=NAME ({choices})"


def shown_names(prims: list[Usd.Prim]) -> dict[str, str]:
    """Map the path of each USD prim with an encoded name (``tn__...``) to the prim's display name."""
    out = {}
    for prim in prims:
        if prim.GetName().startswith("tn__"):
            original = prim.GetMetadata("displayName")
            if original and original.isprintable() and len(original) <= LONGEST:
                out[str(prim.GetPath())] = original
    return out


def named(prims: list[Usd.Prim]) -> list[tuple[Usd.Prim, str]]:
    """Return prims with unique names."""
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    return [(prim, names[str(prim.GetPath())]) for prim in prims]


def _enabled(stage: Stage, prim: Usd.Prim) -> bool:
    enabled = stage.ledger.read(prim, "physics:rigidBodyEnabled", "the choice of bodies") is not False
    if not enabled:
        stage.ledger.assume(prim.GetPath(), "rigidBodyEnabled is 0: its shapes belong to the body above", "no body")
    return enabled


def _link(stage: Stage, prim: Usd.Prim, name: str) -> Link:
    ledger = stage.ledger
    kinematic = bool(ledger.read(prim, "physics:kinematicEnabled", "mocap"))
    weightless = bool(ledger.read(prim, "physxRigidBody:disableGravity", "gravcomp"))
    ledger.mapped(prim.GetPath(), "PhysicsRigidBodyAPI", f"body {name}")
    return Link(str(prim.GetPath()), prim, name, stage.frame(prim), kinematic, weightless)


Velocity = tuple[float, float, float, float, float, float]


def velocity_of(stage: Stage, link: Link) -> Velocity:
    """Return a body's saved velocity: m/s in the world, then rad/s about the body's own axes.

    USD stores a body's velocity in the coordinates of the prim's parent, in stage lengths and degrees.
    """
    linear = stage.ledger.read(link.prim, "physics:velocity", "keyframe home, qvel")
    angular = stage.ledger.read(link.prim, "physics:angularVelocity", "keyframe home, qvel")
    space = rigid_part(stage.matrix(link.prim.GetParent())).rotation
    speed = space @ np.array(linear or (0.0, 0.0, 0.0)) * stage.units.meters
    turning = link.frame.rotation.T @ space @ np.array(angular or (0.0, 0.0, 0.0)) * (math.pi / 180)
    return *vec3(speed), *vec3(turning)
