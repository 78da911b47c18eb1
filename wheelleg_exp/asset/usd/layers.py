"""Looks at the layers of a stage before the USD library composes it: what they are, and how much they make.

The library opens whatever a layer names, waits for a pipe, and composes without end what multiplies: ten references to
a prim with ten references, and so on. It recurses into what is nested, until its stack is full.
"""

from __future__ import annotations

import functools
import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from pxr import Ar, Sdf, Tf

from wheelleg_exp.asset.sources import require_plain_file
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
