"""Open the layers of a USD stage before USD composes them, and report missing layers after the composition.

The USD library opens every file that a layer names, and would wait forever for data from a named pipe.

Missing textures, material libraries, and layers with only visuals are reported. A missing physics layer is an error,
because bodies, joints, and colliders would vanish silently. The prims that refer to a layer, not its name, show whether
it contained physics: mesh files often contain both visuals and colliders.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdPhysics

from wheelleg_exp.asset.file_limits import require_plain_file
from wheelleg_exp.errors import AssetError


def open_layers(source: Path) -> list[Sdf.Layer]:
    """Open the layers of a USD stage and of its variants. Keep the list: USD closes layers that nobody refers to."""
    identifier = str(source.resolve())
    require_plain_file(source, "a layer of USD")
    with Ar.ResolverContextBinder(Ar.GetResolver().CreateDefaultContextForAsset(identifier)):
        root = _read_layer(identifier)
        if root is None:
            expected = "a whole USD layer, text or crate"
            raise AssetError(f"'{source.name}' cannot be read", where=str(source), expected=expected)
        layers: dict[str, Sdf.Layer | None] = {identifier: root}
        todo = [root]
        while todo:
            layer = todo.pop()
            for name in filter(None, layer.GetCompositionAssetDependencies()):  # sublayers, references, payloads
                if name.startswith("`"):
                    message = f"'{layer.GetDisplayName()}' computes the name of a layer: {name[:200]}"
                    raise AssetError(message, where=str(source), expected="the name itself")
                found = Sdf.ComputeAssetPathRelativeToLayer(layer, name)
                if found not in layers:
                    layers[found] = opened = _open_layer(found, layer, name)
                    todo += [opened] if opened else []
    return [layer for layer in layers.values() if layer]


def _open_layer(identifier: str, holder: Sdf.Layer, name: str) -> Sdf.Layer | None:
    file = Ar.GetResolver().Resolve(Sdf.Layer.SplitIdentifier(identifier)[0]).GetPathString()
    path = Path(Ar.SplitPackageRelativePathOuter(file)[0])
    if not file or not Sdf.FileFormat.FindByExtension(file) or not path.exists() or path.is_dir():
        return None
    try:
        require_plain_file(path, "a layer of USD", where=holder.realPath)
    except AssetError as error:
        error.key = _naming_prim(holder, name)
        raise
    try:
        return _read_layer(identifier)
    except Tf.ErrorException:
        return None


def _naming_prim(layer: Sdf.Layer, name: str) -> str | None:
    found: list[Sdf.Path] = []

    def note(path: Sdf.Path) -> None:
        spec = layer.GetPrimAtPath(path) if path.IsPrimPath() or path.IsPrimVariantSelectionPath() else None
        lists = (spec.referenceList, spec.payloadList) if spec else ()
        if any(item.assetPath == name for items in lists for item in items.GetAddedOrExplicitItems()):
            found.append(path.StripAllVariantSelections())

    layer.Traverse("/", note)
    return str(found[0]) if found else None


def _read_layer(identifier: str) -> Sdf.Layer | None:
    layer = Sdf.Layer.FindOrOpen(identifier)
    if layer:
        layer.Reload()
    return layer


_SOLID = re.compile(r"collision|collider", re.IGNORECASE)
_LOOKS = re.compile(r"textur|material|looks?$|visual|shader|light|render", re.IGNORECASE)
_NO_LAYER = re.compile(r"\.(mdl|png|jpe?g|exr|hdr|tga|tiff?)$", re.IGNORECASE)


@dataclass(frozen=True)
class Missing:
    """A missing layer or prim: its name, the prims that name it, and USD's first full error text."""

    name: str
    prims: tuple[Sdf.Path, ...]
    text: str
    is_file: bool

    @property
    def looks_only(self) -> bool:
        """Whether a missing file contains only visuals, judged by its suffix or by the prims that refer to it."""
        inside = (any(_LOOKS.search(path.name) for path in prim.GetPrefixes()) for prim in self.prims)
        return bool(_NO_LAYER.search(self.name)) or all(inside)


def find_missing(usd: Usd.Stage, source: Path) -> list[Missing]:
    """Return the layers and prims that USD composition could not find, without duplicates."""
    found: dict[str, Missing] = {}
    for error in usd.GetCompositionErrors():
        line = " ".join(str(error).split())
        holder = re.search(r"(?:introduced by @[^@]*@|Cycle detected: @[^<]*)<([^>]*)>", line)
        prim = Sdf.Path(holder.group(1)) if holder else Sdf.Path.absoluteRootPath
        file = re.search(r"(?:open asset|load sublayer) @([^@]+)@", line)
        target = re.search(r"Unresolved \w+ prim path @[^@]*@<([^>]*)>", line)
        name = f"a cycle of layers or references at {prim}" if "ycle" in line else line[:200]
        name = target.group(1) if target else name
        name = file.group(1).removeprefix(f"{source.resolve().parent}/") if file else name
        known = found.setdefault(name, Missing(name, (prim,), line, is_file=bool(file)))
        if prim not in known.prims:
            found[name] = replace(known, prims=(*known.prims, prim))
    return list(found.values())


def require_physics(usd: Usd.Stage, prims: Iterable[Usd.Prim], missing: list[Missing], source: Path) -> None:
    """Raise an AssetError if a missing USD layer or prim should contain bodies, joints, or colliders."""
    arcs = [(item, holder) for item in missing if not _NO_LAYER.search(item.name) for holder in item.prims]
    if not arcs:
        return
    files = [item.name for item, _ in arcs if item.is_file]
    for item, holder, lost in _losses(usd, list(prims), arcs):
        also = f", and so is the layer '{files[0]}'" if files and not item.is_file else ""
        missing_is = f"the layer '{item.name}' is missing" if item.is_file else f"'{item.name}' is missing{also}"
        message = f"{missing_is}, and {lost}"
        key = str(holder) if not holder.IsAbsoluteRootPath() else None
        raise AssetError(message, key=key, where=str(source), expected="that layer at the named path")


def _losses(
    usd: Usd.Stage, prims: list[Usd.Prim], arcs: list[tuple[Missing, Sdf.Path]]
) -> Iterator[tuple[Missing, Sdf.Path, str]]:
    joints = [prim for prim in prims if prim.IsA(UsdPhysics.Joint)]
    bodies = [prim.GetPath() for prim in prims if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    gone = [(joint, target) for joint in joints for target in _bodies_of(joint) if not usd.GetPrimAtPath(target)]
    for item, holder in arcs:
        if lost := _colliders(usd, holder):
            yield item, holder, lost
        for joint, target in gone if item.is_file else ():
            if target.HasPrefix(holder):
                yield item, holder, f"{joint.GetPath()} joins the body {target}, which is missing"
        if item.is_file and not joints and sum(path.HasPrefix(holder) for path in bodies) > 1:
            yield item, holder, "nothing joins the bodies of the robot"


def _bodies_of(joint: Usd.Prim) -> Iterator[Sdf.Path]:
    for name in ("physics:body0", "physics:body1"):
        relationship = joint.GetRelationship(name)
        yield from relationship.GetForwardedTargets() if relationship else ()


def _colliders(usd: Usd.Stage, holder: Sdf.Path) -> str:
    """Return an error text if the missing layer at the prim ``holder`` had a collider's shapes, else ``""``."""
    # Search ``holder`` and its ancestors for a collider without shapes; stop at a prim that contains visuals.
    for path in reversed(holder.GetPrefixes()):
        prim = usd.GetPrimAtPath(path)
        if not prim or (_LOOKS.search(path.name) and not _SOLID.search(path.name)):
            return ""
        solid = prim.HasAPI(UsdPhysics.CollisionAPI) or _SOLID.search(path.name)
        if solid and not any(p.IsA(UsdGeom.Gprim) for p in Usd.PrimRange(prim, Usd.TraverseInstanceProxies())):
            return f"the shapes of the collider {path} are missing"
    return ""
