"""What the composition of a stage could not find, and whether the robot can do without it.

A texture, a material library or a visual layer is reported and passed over. A layer of physics is not: bodies, joints
and colliders would vanish without a word. Which of them a layer is, is told by what was referenced from it and where,
not by its name: one file of meshes often holds what is seen and what collides.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from wheelleg_exp.errors import AssetError

_SOLID = re.compile(r"collision|collider", re.IGNORECASE)
_LOOKS = re.compile(r"textur|material|looks?$|visual|shader|light|render", re.IGNORECASE)
_NO_LAYER = re.compile(r"\.(mdl|png|jpe?g|exr|hdr|tga|tiff?)$", re.IGNORECASE)


@dataclass(frozen=True)
class Missing:
    """A layer or prim that is named and not there: its name, the prims that name it, and the first whole complaint."""

    name: str
    prims: tuple[Sdf.Path, ...]
    text: str
    is_file: bool

    @property
    def looks_only(self) -> bool:
        """Return whether nothing but looks was referenced from it: by its kind, or by the prims that name it."""
        return bool(_NO_LAYER.search(self.name)) or all(
            any(_LOOKS.search(path.name) for path in prim.GetPrefixes()) for prim in self.prims
        )

    @property
    def prim(self) -> Sdf.Path:
        """Return the first prim that names it, the stage itself for a sublayer."""
        return self.prims[0]


def find_missing(usd: Usd.Stage, source: Path) -> list[Missing]:
    """Return what the composition could not find, each once; files as seen from the source's folder where possible."""
    found: dict[str, Missing] = {}
    for error in usd.GetCompositionErrors():
        item = _missing(str(error), f"{source.resolve().parent}/")
        known = found.setdefault(item.name, item)
        if item.prim not in known.prims:
            found[item.name] = replace(known, prims=(*known.prims, item.prim))
    return list(found.values())


def _missing(text: str, folder: str) -> Missing:
    line = " ".join(text.split())
    holder = re.search(r"(?:introduced by @[^@]*@|Cycle detected: @[^<]*)<([^>]*)>", line)
    prim = Sdf.Path(holder.group(1)) if holder else Sdf.Path.absoluteRootPath
    file = re.search(r"(?:open asset|load sublayer) @([^@]+)@", line)
    if file:
        return Missing(file.group(1).removeprefix(folder), (prim,), line, is_file=True)
    target = re.search(r"Unresolved \w+ prim path @[^@]*@<([^>]*)>", line)
    if target:
        return Missing(target.group(1), (prim,), line, is_file=False)
    if "ycle" in line:
        return Missing(f"a cycle of layers or references at {prim}", (prim,), line, is_file=False)
    return Missing(line[:200], (prim,), line, is_file=False)


def require_physics(usd: Usd.Stage, prims: Iterable[Usd.Prim], missing: list[Missing], source: Path) -> None:
    """Refuse a stage that physics is missing from.

    Raises:
        AssetError: a layer is missing, and a joint names a body, or a collider a shape, that it should have brought;
            or bodies that nothing joins stand where it should have brought more.
    """
    arcs = [(item, holder) for item in missing if not _NO_LAYER.search(item.name) for holder in item.prims]
    if not arcs:
        return
    files = [item.name for item, _ in arcs if item.is_file]
    for item, holder, lost in _losses(usd, list(prims), arcs):
        also = f", nor is the layer '{files[0]}'" if files and not item.is_file else ""
        missing_is = f"the layer '{item.name}' is missing" if item.is_file else f"'{item.name}' is not there{also}"
        raise AssetError(
            f"{missing_is}, and {lost}",
            key=str(holder) if not holder.IsAbsoluteRootPath() else None,
            where=str(source),
            expected="that layer where the file names it, beside the others",
        )


def _losses(
    usd: Usd.Stage, prims: list[Usd.Prim], arcs: list[tuple[Missing, Sdf.Path]]
) -> Iterator[tuple[Missing, Sdf.Path, str]]:
    """Yield the missing layers that physics was referenced from, with the prims that did so, and what is lost."""
    joints = [prim for prim in prims if prim.IsA(UsdPhysics.Joint)]
    bodies = [prim.GetPath() for prim in prims if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    gone = [(joint, target) for joint in joints for target in _bodies_of(joint) if not usd.GetPrimAtPath(target)]
    for item, holder in arcs:
        if lost := _colliders(usd, holder):
            yield item, holder, lost
        for joint, target in gone if item.is_file else ():
            if target.HasPrefix(holder):
                yield item, holder, f"{joint.GetPath()} joins the body {target}, which is not there"
        if item.is_file and not joints and sum(path.HasPrefix(holder) for path in bodies) > 1:
            yield item, holder, "nothing joins the bodies of the robot"


def _bodies_of(joint: Usd.Prim) -> Iterator[Sdf.Path]:
    for name in ("physics:body0", "physics:body1"):
        relationship = joint.GetRelationship(name)
        yield from relationship.GetForwardedTargets() if relationship else ()


def _colliders(usd: Usd.Stage, holder: Sdf.Path) -> str:
    """Return what collides without the shapes that ``holder`` should have brought, nothing when it brings none."""
    for path in reversed(holder.GetPrefixes()):
        prim = usd.GetPrimAtPath(path)
        if not prim or (_LOOKS.search(path.name) and not _SOLID.search(path.name)):
            return ""
        solid = prim.HasAPI(UsdPhysics.CollisionAPI) or _SOLID.search(path.name)
        if solid and not any(p.IsA(UsdGeom.Gprim) for p in Usd.PrimRange(prim, Usd.TraverseInstanceProxies())):
            return f"{path} collides by shapes that are not there"
    return ""
