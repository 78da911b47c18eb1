"""Finds the rigid bodies and says which body a prim belongs to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pxr import Sdf, Usd

from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.reader.stage import Stage, schemas
from wheelleg_exp.errors import AssetError


@dataclass
class Link:
    """A rigid body as drawn: its prim, name and frame in the world."""

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

    def __iter__(self) -> Iterator[Link]:
        return iter(self.by_path.values())

    def owner(self, path: Sdf.Path) -> Link | None:
        """Return the body at ``path`` or above it, None for what belongs to the world."""
        while not path.isEmpty and not path.IsAbsoluteRootPath():
            if link := self.by_path.get(str(path)):
                return link
            path = path.GetParentPath()
        return None

    def below(self, path: Sdf.Path) -> list[Link]:
        """Return the bodies at or below ``path``."""
        return [link for link in self.by_path.values() if Sdf.Path(link.path).HasPrefix(path)]


def find_links(stage: Stage) -> Links:
    """Return the enabled rigid bodies.

    Raises:
        AssetError: there is none.
    """
    prims = [prim for prim in stage.prims if "PhysicsRigidBodyAPI" in schemas(prim) and _enabled(stage, prim)]
    if not prims:
        raise _no_articulation(stage)
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    return Links([_link(stage, prim, names[str(prim.GetPath())]) for prim in prims])


def _no_articulation(stage: Stage) -> AssetError:
    name, missing = stage.source.name, ", ".join(stage.unresolved)
    if missing:
        return AssetError(
            f"'{name}' has no articulation, and layers that it names are missing: {missing}",
            where=str(stage.source),
            expected="those layers beside the file, and PhysicsRigidBodyAPI on prims below the default prim",
        )
    return AssetError(
        f"'{name}' has no articulation: no prim carries PhysicsRigidBodyAPI",
        where=str(stage.source),
        expected="rigid bodies below the default prim; is the variant with the physics selected?",
    )


def shown_names(prims: list[Usd.Prim]) -> dict[str, str]:
    """Return the original names of prims whose own name is an encoded form of it (``tn__...``)."""
    return {
        str(prim.GetPath()): prim.GetMetadata("displayName")
        for prim in prims
        if prim.GetName().startswith("tn__") and prim.GetMetadata("displayName")
    }


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
