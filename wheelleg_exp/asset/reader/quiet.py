"""Finds articulations whose own bodies do not touch each other."""

from __future__ import annotations

from pxr import Sdf

from wheelleg_exp.asset.reader.bodies import Link
from wheelleg_exp.asset.reader.roots import Graph
from wheelleg_exp.asset.reader.stage import Stage, schemas

SWITCHES = ("physxArticulation:enabledSelfCollisions", "newton:selfCollisionEnabled")


def quiet_parts(stage: Stage, graph: Graph) -> list[frozenset[str]]:
    """Return the bodies, by path, of each articulation whose self-collision is switched off."""
    parts: dict[frozenset[str], None] = {}
    for prim in (prim for prim in stage.prims if schemas(prim)):
        values = [stage.ledger.read(prim, name, "contype and conaffinity of the colliders") for name in SWITCHES]
        if all(value is None or value for value in values):
            continue
        for link in _meant(graph, str(prim.GetPath())):
            parts[frozenset(other.path for other in graph.component(link))] = None
    return list(parts)


def _meant(graph: Graph, path: str) -> list[Link]:
    """Return the bodies that a switch on a prim speaks of: those at or below it, or those that a joint joins."""
    joined = [link for joint in graph.joints if joint.path == path for link in joint.links if link]
    return joined or graph.links.below(Sdf.Path(path))


def all_quiet(parts: list[frozenset[str]], solid: set[str]) -> bool:
    """Return whether one such articulation holds all bodies that collide."""
    return len(parts) == 1 and solid <= parts[0]
