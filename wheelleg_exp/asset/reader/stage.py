"""Opens a USD file, chooses its variants, and says which prims are the robot's."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from wheelleg_exp.asset.geometry import Array, Frame, rigid_part
from wheelleg_exp.asset.reader.ledger import Ledger
from wheelleg_exp.asset.reader.units import Units
from wheelleg_exp.errors import AssetError, nearest_name

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


@dataclass
class Stage:
    """An open stage and what the readers share: units, the prims to read, transforms, and the ledger."""

    usd: Usd.Stage
    source: Path
    units: Units
    root: Usd.Prim
    prims: list[Usd.Prim]
    layers: dict[str, str]
    unresolved: tuple[str, ...]
    variants: dict[str, str]
    ledger: Ledger = field(default_factory=Ledger)

    def __post_init__(self) -> None:
        self._xforms = UsdGeom.XformCache(Usd.TimeCode.Default())
        self._world = self.units.world()

    def matrix(self, prim: Usd.Prim | None) -> Array:
        """Return the 4x4 map from a prim's coordinates (None: the stage's) to the world in metres, z up."""
        if prim is None:
            return self._world
        local = np.array(self._xforms.GetLocalToWorldTransform(prim), dtype=float).T
        if not np.isfinite(local).all():
            raise AssetError(
                "the transform is not finite",
                key=str(prim.GetPath()),
                expected="finite xformOps, no scale of 0",
            )
        return np.asarray(self._world @ local)

    def frame(self, prim: Usd.Prim) -> Frame:
        """Return a prim's frame in the world, without scale."""
        return rigid_part(self.matrix(prim))


def schemas(prim: Usd.Prim) -> list[str]:
    """Return the applied API schemas as authored, those that the USD library does not know included."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


def open_stage(source: Path, variants: Mapping[str, str]) -> Stage:
    """Open ``source`` with everything loaded.

    Raises:
        AssetError: there is no such file, it is no USD, or it has no such variant.
    """
    if not source.is_file():
        raise AssetError(f"there is no file '{source}'", expected="a USD file")
    if source.suffix.lower() not in SUFFIXES:
        raise AssetError(f"'{source.name}' is not a USD file", where=str(source), expected=", ".join(SUFFIXES))
    delegate = UsdUtils.CoalescingDiagnosticDelegate()  # keeps the library's own messages off the terminal
    try:
        usd = Usd.Stage.Open(str(source.resolve()), Usd.Stage.LoadAll)
        usd.Reload()
        chosen = _choose(usd, variants)
        return _collect(usd, source, chosen)
    except Tf.ErrorException as error:
        raise _unreadable(source, error) from None
    finally:
        delegate.TakeUncoalescedDiagnostics()


def _unreadable(source: Path, error: Tf.ErrorException) -> AssetError:
    """Return the library's first complaint: for a text layer with its line and what stands there."""
    first = str(error).strip().split("Error in ")[1:2] or [str(error)]
    text = " ".join(first[0].split(" : ", 1)[-1].split()).strip("' ")
    place = re.search(r"(\S+?):(\d+):(\d+): .*?(Expected .*?)?at (.*)$", text)
    if place is None:
        return AssetError(f"'{source.name}' cannot be read: {text}", where=str(source))
    path, line, _, expected, found = place.groups()
    return AssetError(
        f"'{source.name}' cannot be read: something is wrong at {found.strip()}",
        where=f"{path}:{line}",
        expected=expected.removeprefix("Expected ").strip() if expected else "a valid USD layer",
    )


def _choose(usd: Usd.Stage, variants: Mapping[str, str]) -> dict[str, str]:
    root = usd.GetDefaultPrim() or usd.GetPseudoRoot()
    usd.SetEditTarget(usd.GetSessionLayer())
    for name, wanted in variants.items():
        holders = [prim for prim in Usd.PrimRange(root) if name in prim.GetVariantSets().GetNames()]
        if not holders:
            known = root.GetVariantSets().GetNames()
            raise AssetError(
                f"there is no variant set '{name}'",
                key=f"--variant {name}={wanted}",
                expected="one of " + ", ".join(known) if known else "no variants: the file has none",
                nearest=nearest_name(name, known),
            )
        options = holders[0].GetVariantSet(name).GetVariantNames()
        if wanted not in options:
            raise AssetError(
                f"variant set '{name}' has no '{wanted}'",
                key=f"--variant {name}={wanted}",
                expected="one of " + ", ".join(options),
                nearest=nearest_name(wanted, options),
            )
        holders[0].GetVariantSet(name).SetVariantSelection(wanted)
    sets = root.GetVariantSets()
    return {name: sets.GetVariantSelection(name) for name in sorted(sets.GetNames())}


def _collect(usd: Usd.Stage, source: Path, variants: dict[str, str]) -> Stage:
    units = Units(
        UsdGeom.GetStageMetersPerUnit(usd),
        UsdPhysics.GetStageKilogramsPerUnit(usd),
        UsdGeom.GetStageUpAxis(usd),
    )
    root = usd.GetDefaultPrim() or usd.GetPseudoRoot()
    prims = [prim for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies()) if not prim.IsPseudoRoot()]
    stage = Stage(usd, source, units, root, prims, _hashes(usd, source), _unresolved(usd, source), variants)
    for text in stage.unresolved:
        stage.ledger.warn(f"not found, read without it: {text}")
    _note_units(stage)
    return stage


def _note_units(stage: Stage) -> None:
    top = stage.usd.GetPseudoRoot()
    for name, value in (("metersPerUnit", 0.01), ("upAxis", "Y")):
        if not top.HasAuthoredMetadata(name):
            stage.ledger.assume(stage.source.name, f"no {name}: USD's fallback", value)
    if not stage.usd.HasDefaultPrim():
        stage.ledger.assume(stage.source.name, "no defaultPrim: the whole stage is read", "/")


def _real_path(layer: Sdf.Layer) -> Path | None:
    """Return the file that holds a layer; one inside a package is held by the package."""
    if layer.anonymous or not layer.realPath:
        return None
    return Path(layer.realPath.split("[")[0])


def _hashes(usd: Usd.Stage, source: Path) -> dict[str, str]:
    folder = source.resolve().parent
    files = {path for layer in usd.GetUsedLayers() if (path := _real_path(layer))}
    return {relative_name(path, folder): hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(files)}


def relative_name(path: Path, folder: Path) -> str:
    """Return ``path`` as seen from ``folder``, with slashes, climbing out of it where needed."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _unresolved(usd: Usd.Stage, source: Path) -> tuple[str, ...]:
    """Return what the composition could not find, as seen from the source's folder where that is possible."""
    found: dict[str, None] = {}
    for error in usd.GetCompositionErrors():
        text = str(error).splitlines()[0]
        name = re.search(r"open asset @([^@]+)@", text)
        found[(name.group(1) if name else text).removeprefix(f"{source.resolve().parent}/")] = None
    return tuple(found)
