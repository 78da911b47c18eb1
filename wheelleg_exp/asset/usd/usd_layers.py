"""Check a stage's layers: before composition, their size and number; after composition, which of them are missing.

The USD library opens whatever a layer names, waits for a pipe, composes references that multiply without limit (ten
references to a prim with ten references, and so on), and recurses until its stack is full.

A missing texture, material library, or visual layer is reported and skipped. A missing physics layer is an error,
because bodies, joints, and colliders would vanish silently. What was referenced from a layer, and where, decides
its kind, not its name: one mesh file often holds both visuals and colliders.
"""

from __future__ import annotations

import functools
import mmap
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdPhysics

from wheelleg_exp.asset.file_limits import require_plain_file
from wheelleg_exp.errors import AssetError

MOST_SPECS = 1_000_000  # looked at by composition: each prim in each layer that may hold it
MOST_SUBLAYERS = 1_000
DEEPEST = 10_000  # prims inside each other; the library's stack is full at some 50,000

_TOKENS = re.compile(  # texts, paths and comments, those without end up to the end of the file; and braces
    rb'"""(?:[^\\]|\\.)*?(?:"""|\Z)|\'\'\'(?:[^\\]|\\.)*?(?:\'\'\'|\Z)|"(?:[^"\\\n]|\\.)*"|\'(?:[^\'\\\n]|\\.)*\''
    rb"|@.*?(?:@|\Z)|@[^@\n]*@|#[^\n]*|//[^\n]*|/\*.*?(?:\*/|\Z)|[{}]",
    re.DOTALL,
)

Place = tuple[Sdf.Layer, Sdf.Path, bool]
"""A prim: the layer on top of those that may hold it, its path there, and whether another prim refers to it."""


def open_layers(source: Path) -> list[Sdf.Layer]:
    """Open a stage's layers, those of all variants; they stay open as long as somebody holds them.

    Raises:
        AssetError: a layer is a pipe, a device or too large, prims are nested too deep, or composition would make too
            many of them.
        Tf.ErrorException: ``source`` itself cannot be read.
    """
    identifier = str(source.resolve())
    with Ar.ResolverContextBinder(Ar.GetResolver().CreateDefaultContextForAsset(identifier)):
        layers = _Layers(source, identifier)
        layers.require_bounded()
    return [layer for layer in layers.named.values() if layer]


class _Layers:
    """A stage's layers by identifier; None for one that cannot be read."""

    def __init__(self, source: Path, identifier: str) -> None:
        self.source = source
        self.named: dict[str, Sdf.Layer | None] = {}
        self.shallow: set[Path] = set()
        self.root = self._open(identifier)
        if self.root is None:
            self._refuse(f"'{source.name}' cannot be read", "a whole USD layer, text or crate")
        self.stack = functools.cache(self._stack)

    def _open(self, identifier: str, holder: Sdf.Layer | None = None, prim: Sdf.Path | None = None) -> Sdf.Layer | None:
        if identifier not in self.named:
            file = Ar.GetResolver().Resolve(Sdf.Layer.SplitIdentifier(identifier)[0]).GetPathString()
            path = Path(Ar.SplitPackageRelativePathOuter(file)[0])
            there = file and Sdf.FileFormat.FindByExtension(file) and path.exists() and not path.is_dir()
            if there:
                where = holder.realPath if holder else None
                require_plain_file(path, "a layer of USD", key=str(prim) if prim else None, where=where)
                self._require_shallow(path)
            self.named[identifier] = self._read(identifier) if there else None
        return self.named[identifier]

    def _read(self, identifier: str) -> Sdf.Layer | None:
        try:
            layer = Sdf.Layer.FindOrOpen(identifier)
        except Tf.ErrorException:  # of another layer than the source: told when the stage needs it
            if not self.named:
                raise
            return None
        if layer:
            layer.Reload()
        return layer

    def _target(self, holder: Sdf.Layer, name: str, prim: Sdf.Path | None = None) -> Sdf.Layer | None:
        if name.startswith("`"):
            self._refuse(f"'{holder.GetDisplayName()}' computes the name of a layer: {name[:200]}", "the name itself")
        return self._open(Sdf.ComputeAssetPathRelativeToLayer(holder, name), holder, prim)

    def _stack(self, layer: Sdf.Layer) -> list[Sdf.Layer]:
        """Return a layer and those below it, each as often as it is named; circles are cut."""
        found, todo = [], [(layer, frozenset([layer]))]
        while todo:
            item, above = todo.pop()
            found.append(item)
            if len(found) > MOST_SUBLAYERS:
                self._refuse(f"'{layer.GetDisplayName()}' has more than {MOST_SUBLAYERS:,} layers below it", "fewer")
            below = [self._target(item, name) for name in item.subLayerPaths]
            todo += [(sub, above | {sub}) for sub in below if sub and sub not in above]
        return found

    # ------------------------------------------------------------ how much composition makes
    def require_bounded(self) -> None:
        """Go through each prim of each layer once, and count what all of them make together."""
        parts: dict[Place, list[Place]] = {}
        sizes: dict[Place, tuple[int, int]] = {}
        work, todo = 0, [(self.root, Sdf.Path.absoluteRootPath, False)]
        while todo:
            place = todo[-1]
            if place not in parts:
                parts[place] = list(dict.fromkeys(self._parts(*place)))
                work += len(self.stack(place[0])) + len(parts[place])
                self._require_few(work, 0)
                todo += [part for part in parts[place] if part not in parts]
            else:
                todo.pop()
                found = [sizes.get(part, (0, 0)) for part in parts[place]]  # none yet: a circle, which is cut
                count = len(self.stack(place[0])) + sum(count for count, _ in found)
                sizes[place] = count, 1 + max((depth for _, depth in found), default=0)
                self._require_few(*sizes[place])

    def _require_few(self, count: int, depth: int, where: Path | None = None) -> None:
        if count > MOST_SPECS:
            self._refuse(f"the layers of '{self.source.name}' multiply to more than {MOST_SPECS:,} prims", "one robot")
        if depth > DEEPEST:
            self._refuse(f"prims stand more than {DEEPEST:,} deep inside each other", "fewer", where)

    def _parts(self, layer: Sdf.Layer, path: Sdf.Path, referred: bool) -> Iterator[Place]:
        """Yield what a prim is made of: its children, what it refers to, and what the prims above it refer to."""
        for holder, spec in self._specs(layer, path):
            yield from ((layer, child.path, False) for child in spec.nameChildren)
            yield from self._arcs(layer, holder, spec)
        for above in path.GetPrefixes()[:-1] if referred else []:
            for holder, spec in self._specs(layer, above):
                yield layer, path.ReplacePrefix(above, spec.path), False
                for other, target, _ in self._arcs(layer, holder, spec):
                    yield other, path.ReplacePrefix(above, target), True

    def _specs(self, layer: Sdf.Layer, path: Sdf.Path) -> Iterator[tuple[Sdf.Layer, Sdf.PrimSpec]]:
        """Yield what each layer says of a prim, in all variants."""
        for holder in self.stack(layer):
            todo = [holder.GetPrimAtPath(path)]
            while todo:
                spec = todo.pop()
                if spec:
                    yield holder, spec
                    variants = (variant for item in spec.variantSets.values() for variant in item.variants.values())
                    todo += [variant.primSpec for variant in variants]

    def _arcs(self, layer: Sdf.Layer, holder: Sdf.Layer, spec: Sdf.PrimSpec) -> Iterator[Place]:
        for items in (spec.inheritPathList, spec.specializesList):
            yield from ((layer, path, True) for path in items.GetAddedOrExplicitItems())
        for items in (spec.referenceList, spec.payloadList):
            for item in items.GetAddedOrExplicitItems():
                target = self._target(holder, item.assetPath, spec.path) if item.assetPath else layer
                path = item.primPath or (Sdf.Path(f"/{target.defaultPrim}") if target and target.defaultPrim else None)
                if target and path:
                    yield target, path, True

    # ------------------------------------------------------------ depth
    def _require_shallow(self, path: Path) -> None:
        """Refuse a text in which braces are nested too deep, also one in a package."""
        if path in self.shallow:
            return
        self.shallow.add(path)
        with path.open("rb") as file:
            if sum(part.count(b"{") for part in iter(lambda: file.read(2**20), b"")) <= DEEPEST:
                return
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        with data:
            start = data.find(b"#usda") if data[:2] == b"PK" else 0 if data[:5] == b"#usda" else -1
            depth = 0
            for token in _TOKENS.finditer(data, start) if start >= 0 else ():
                depth += {b"{": 1, b"}": -1}.get(token.group(), 0)
                self._require_few(0, depth, path)

    def _refuse(self, message: str, expected: str, where: Path | None = None) -> NoReturn:
        raise AssetError(message, where=str(where or self.source), expected=expected)


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
