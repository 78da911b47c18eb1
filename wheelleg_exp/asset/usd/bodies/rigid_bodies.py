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
    ledger, prims, links = stage.ledger, list[Usd.Prim](), list[Link]()
    for prim in stage.prims:
        if "PhysicsRigidBodyAPI" in schemas(prim):
            if ledger.read(prim, "physics:rigidBodyEnabled", "the choice of bodies") is not False:
                prims.append(prim)
            else:
                ledger.assume(prim.GetPath(), "rigidBodyEnabled is 0: its shapes belong to the body above", "no body")
    if not prims:
        raise _no_articulation(stage)
    require_size(len(prims), MOST_BODIES, "rigid bodies", where=str(stage.source))
    for prim, name in named(prims):
        kinematic = bool(ledger.read(prim, "physics:kinematicEnabled", "mocap"))
        weightless = bool(ledger.read(prim, "physxRigidBody:disableGravity", "gravcomp"))
        ledger.mapped(prim.GetPath(), "PhysicsRigidBodyAPI", f"body {name}")
        links.append(Link(str(prim.GetPath()), prim, name, stage.frame(prim), kinematic, weightless))
    return Links(links)


def _no_articulation(stage: Stage) -> AssetError:
    name, where, root, sets = stage.source.name, str(stage.source), stage.root, variant_sets(stage.root)
    if stage.unresolved:
        message = f"'{name}' has no articulation, and layers that it names are missing: {', '.join(stage.unresolved)}"
        expected = "those layers next to the file, and PhysicsRigidBodyAPI on prims below the default prim"
        return AssetError(message, where=where, expected=expected)
    elsewhere = [prim for prim in stage.usd.Traverse() if "PhysicsRigidBodyAPI" in schemas(prim)]
    why = f" there; outside of {root.GetPath()} there is {elsewhere[0].GetPath()}" if elsewhere else ""
    if not root.IsActive():
        why = f", and {root.GetPath()} is switched off (active = false)"
    elif root.IsAbstract():
        why = f", and {root.GetPath()} is a class, which has no effect until it is referenced"
    elif not root.IsDefined():
        why = f", and {root.GetPath()} is an 'over' without a definition"
    choices = "; ".join(f"{variant}: {', '.join(options)}" for variant, options in sets.items())
    choice = (
        f"or another variant, by --variant SET=NAME ({choices})" if sets else "the file has no variants to choose from"
    )
    message = f"'{name}' has no articulation: no prim carries PhysicsRigidBodyAPI{why}"
    return AssetError(message, where=where, expected=f"rigid bodies below the default prim; {choice}")


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


def velocity_of(stage: Stage, link: Link) -> tuple[float, float, float, float, float, float]:
    """Return a body's saved velocity: m/s in the world, then rad/s in its own axes; USD has the parent prim's axes."""
    linear = stage.ledger.read(link.prim, "physics:velocity", "keyframe home, qvel")
    angular = stage.ledger.read(link.prim, "physics:angularVelocity", "keyframe home, qvel")
    space = rigid_part(stage.matrix(link.prim.GetParent())).rotation
    speed = space @ np.array(linear or (0.0, 0.0, 0.0)) * stage.units.meters
    turning = link.frame.rotation.T @ space @ np.array(angular or (0.0, 0.0, 0.0)) * (math.pi / 180)
    return *vec3(speed), *vec3(turning)
