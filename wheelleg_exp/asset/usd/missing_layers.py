"""What the composition of a stage could not find, and whether the robot can do without it.

A texture, a material library or a visual layer is reported and passed over. A layer of physics is not: bodies, joints
and colliders would vanish without a word. A layer is one of physics when its name says so, or when something that
stands in the file points at what it should have brought.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from wheelleg_exp.errors import AssetError

_PHYSICS = re.compile(r"physics|physx|joint|collision|collider|articulation|rigid", re.IGNORECASE)
_LOOKS = re.compile(r"textur|material|looks?\b|visual|shader|light|render|\.(mdl|png|jpe?g|exr|hdr|tga|tiff?)$", re.I)


@dataclass(frozen=True)
class Missing:
    """A layer or prim that is named and not there: its name, the prim that names it, and the whole complaint."""

    name: str
    prim: Sdf.Path
    text: str
    is_file: bool

    @property
    def looks_only(self) -> bool:
        """Return whether it is for looks, by its own name or by where it is named."""
        own = "/".join(Path(self.name).parts[-2:])
        return not _PHYSICS.search(Path(self.name).name) and bool(_LOOKS.search(own) or _LOOKS.search(str(self.prim)))

    @property
    def says_physics(self) -> bool:
        """Return whether its name says that it holds physics."""
        return self.is_file and bool(_PHYSICS.search(Path(self.name).name))


def find_missing(usd: Usd.Stage, source: Path) -> list[Missing]:
    """Return what the composition could not find, each once; files as seen from the source's folder where possible."""
    found: dict[str, Missing] = {}
    for error in usd.GetCompositionErrors():
        item = _missing(str(error), f"{source.resolve().parent}/")
        found.setdefault(item.name, item)
    return list(found.values())


def _missing(text: str, folder: str) -> Missing:
    line = " ".join(text.split())
    holder = re.search(r"(?:introduced by @[^@]*@|Cycle detected: @[^<]*)<([^>]*)>", line)
    prim = Sdf.Path(holder.group(1)) if holder else Sdf.Path.absoluteRootPath
    file = re.search(r"(?:open asset|load sublayer) @([^@]+)@", line)
    if file:
        return Missing(file.group(1).removeprefix(folder), prim, line, is_file=True)
    target = re.search(r"Unresolved \w+ prim path @[^@]*@<([^>]*)>", line)
    if target:
        return Missing(target.group(1), prim, line, is_file=False)
    if "ycle" in line:
        return Missing(f"a cycle of layers or references at {prim}", prim, line, is_file=False)
    return Missing(line[:200], prim, line, is_file=False)


def require_physics(usd: Usd.Stage, prims: Iterable[Usd.Prim], missing: list[Missing], source: Path) -> None:
    """Refuse a stage that physics is missing from.

    Raises:
        AssetError: a missing layer is called after physics; or a layer is missing, and a joint names a body or a
            collider a shape that it should have brought.
    """
    for item in missing:
        if item.says_physics:
            raise _error(item, source, "it holds physics, by its name")
    unknown = [item for item in missing if item.is_file and not item.looks_only]
    if unknown:
        for prim in prims:
            lost = _lost(usd, prim, unknown)
            if lost:
                raise _error(unknown[0], source, lost)


def _error(item: Missing, source: Path, reason: str) -> AssetError:
    return AssetError(
        f"the layer '{item.name}' is missing, and {reason}",
        key=str(item.prim) if not item.prim.IsAbsoluteRootPath() else None,
        where=str(source),
        expected="that layer where the file names it, beside the others",
    )


def _lost(usd: Usd.Stage, prim: Usd.Prim, unknown: list[Missing]) -> str:
    """Return what a prim points at in vain, nothing when all is there."""
    if prim.IsA(UsdPhysics.Joint):
        for name in ("physics:body0", "physics:body1"):
            relationship = prim.GetRelationship(name)
            for target in relationship.GetForwardedTargets() if relationship else []:
                if not usd.GetPrimAtPath(target):
                    return f"{prim.GetPath()} joins the body {target}, which is not there"
    elif prim.HasAPI(UsdPhysics.CollisionAPI) and not prim.IsA(UsdGeom.Gprim):
        below = [item for item in unknown if item.prim.HasPrefix(prim.GetPath())]
        if below and not any(p.IsA(UsdGeom.Gprim) for p in Usd.PrimRange(prim, Usd.TraverseInstanceProxies())):
            return f"{prim.GetPath()} collides by shapes that are not there"
    return ""
