"""Opens a USD file, chooses its variants, and says which prims are the robot's."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from wheelleg_exp.asset.geometry import Array, Frame, rigid_part
from wheelleg_exp.asset.sources import FARTHEST, FETCH, MOST_PRIMS, POINTER, require_plain_file, require_size
from wheelleg_exp.asset.usd.layers import open_layers
from wheelleg_exp.asset.usd.ledger import Ledger
from wheelleg_exp.asset.usd.missing_layers import Missing, find_missing, require_physics
from wheelleg_exp.asset.usd.units import Units
from wheelleg_exp.asset.usd.variants import choose, unselected
from wheelleg_exp.errors import AssetError

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MOST_SCHEMAS = 200  # of one prim; the library's time for them grows with the square


@dataclass
class Stage:
    """An open stage and what the readers share: units, the prims to read, transforms, and the ledger.

    ``prims`` stands in the stage's order and leaves out what hangs below a PointInstancer, which is drawn only where
    the instancer puts it.
    """

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
        """Return the 4x4 map from a prim's coordinates (None: the stage's) to the world in metres, z up.

        Raises:
            AssetError: an xformOp is none, it holds NaN or infinity, or carries the prim farther than robots reach.
        """
        if prim is None:
            return self._world
        try:
            local = np.array(self._xforms.GetLocalToWorldTransform(prim), dtype=float).T
        except Tf.ErrorException as error:
            raise _bad_transform(prim, _complaint(error), "xformOps of this prim, each with its own type") from None
        with np.errstate(all="ignore"):
            out = np.asarray(self._world @ local)
        if not np.isfinite(out).all():
            raise _bad_transform(prim, "the transform is not finite", "finite xformOps")
        if np.abs(out).max() > FARTHEST:
            raise _bad_transform(prim, f"the transform reaches {np.abs(out).max():.3g} m", f"less than {FARTHEST:g} m")
        return out

    def frame(self, prim: Usd.Prim) -> Frame:
        """Return a prim's frame in the world, without scale."""
        return rigid_part(self.matrix(prim))


def _bad_transform(prim: Usd.Prim, message: str, expected: str) -> AssetError:
    return AssetError(message, key=str(prim.GetPath()), expected=expected)


def schemas(prim: Usd.Prim) -> list[str]:
    """Return the applied API schemas as authored, those that the USD library does not know included."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


def open_stage(source: Path, variants: Mapping[str, str]) -> Stage:
    """Open ``source`` with everything loaded.

    Raises:
        AssetError: there is no such file, it is no USD, it has no such variant, a layer of physics is missing, or the
            stage is larger than any robot's.
    """
    _require_file(source)
    with library(source):
        root, *_ = open_layers(source)  # the stage takes the others that are open
        usd = Usd.Stage.Open(root, Usd.Stage.LoadAll)
        sampled = _settle_samples(usd)
        chosen = choose(usd, variants)
        stage = _collect(usd, source, chosen)
        for path in sampled:
            stage.ledger.assume(path, "only time samples, no default: the first one", "the stage at its start")
        return stage


@contextmanager
def library(source: Path) -> Iterator[None]:
    """Keep the USD library's messages off the terminal, and tell its complaints, and those of the disk, as our own.

    Raises:
        AssetError: the library cannot make sense of the file, or a layer cannot be read.
    """
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    except Tf.ErrorException as error:
        raise _unreadable(source, error) from None
    except UnicodeDecodeError:
        expected = "UTF-8"
        raise AssetError(f"'{source.name}' holds text that is none", where=str(source), expected=expected) from None
    except OSError as error:
        raise AssetError(f"cannot be read: {error.strerror}", key=str(error.filename or source)) from None
    finally:
        delegate.TakeUncoalescedDiagnostics()


def _require_file(source: Path) -> None:
    expected = "a USD file (" + ", ".join(SUFFIXES) + ")"
    require_plain_file(source, expected)
    try:
        if source.suffix.lower() not in SUFFIXES:
            raise AssetError(f"'{source.name}' is not a USD file", where=str(source), expected=", ".join(SUFFIXES))
        with source.open("rb") as file:
            start = file.read(len(POINTER))
        if not start:
            raise AssetError(f"'{source.name}' is empty", where=str(source), expected=expected)
        if start == POINTER:
            raise AssetError(f"'{source.name}' is {FETCH}", where=str(source), expected=expected)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise AssetError(f"'{source}' cannot be read: {reason}", expected=expected) from None


def _unreadable(source: Path, error: Tf.ErrorException) -> AssetError:
    """Return the library's first complaint: for a text layer with its line and what stands there."""
    text = _complaint(error)
    place = re.search(r"(\S+?):(\d+):(\d+): .*?(Expected .*?)?at (.*)$", text)
    if place is None:
        expected = "a whole USD layer, text or crate"
        return AssetError(f"'{source.name}' cannot be read: {text}", where=str(source), expected=expected)
    path, line, _, expected, found = place.groups()
    return AssetError(
        f"'{source.name}' cannot be read: something is wrong at {found.strip()[:200]}",
        where=f"{path}:{line}",
        expected=expected.removeprefix("Expected ").strip() if expected else "a valid USD layer",
    )


def _complaint(error: Tf.ErrorException) -> str:
    """Return the library's first complaint, without where it stands in the library."""
    first = str(error).strip().split("Error in ")[1:2] or [str(error)]
    text = " ".join(first[0].split(" : ", 1)[-1].split()).strip("' ")
    return text if len(text) <= 300 else text[:300] + "..."


def _settle_samples(usd: Usd.Stage) -> list[str]:
    """Give attributes that are authored over time alone their first sample, in memory; return their paths.

    Everything is read at the default time, where such an attribute has no value.
    """
    settled = []
    for layer in usd.GetUsedLayers():
        if not layer.ListAllTimeSamples():
            continue
        for path in _attributes(layer):
            spec = layer.GetAttributeAtPath(path)
            times = layer.ListTimeSamplesForPath(path) if spec and not spec.HasDefaultValue() else []
            value = layer.QueryTimeSample(path, times[0]) if times else None
            if value is not None and not isinstance(value, Sdf.ValueBlock):
                spec.default = value
                settled.append(str(path))
    return settled


def _attributes(layer: Sdf.Layer) -> list[Sdf.Path]:
    found: list[Sdf.Path] = []
    layer.Traverse("/", lambda path: found.append(path) if path.IsPropertyPath() else None)
    return found


def _collect(usd: Usd.Stage, source: Path, variants: dict[str, str]) -> Stage:
    root = usd.GetDefaultPrim() or usd.GetPseudoRoot()
    prims = _prims(root, source)
    missing = find_missing(usd, source)
    require_physics(usd, prims, missing, source)
    names = tuple(item.name for item in missing)
    stage = Stage(usd, source, _units(usd, source), root, prims, _hashes(usd, source), names, variants)
    for item in missing:
        stage.ledger.warn(_told(item))
        stage.ledger.find("layer_not_found", item.name, item.prim, places=len(item.prims), looks=item.looks_only)
    for text in unselected(root):
        stage.ledger.warn(text)
    _note_metadata(stage)
    return stage


def _told(item: Missing) -> str:
    if not item.is_file:
        return f"{item.prim}: not found or going in circles, read without it: {item.name}"
    return f"not found, read without it: {item.name}"


def _prims(root: Usd.Prim, source: Path) -> list[Usd.Prim]:
    found = []
    walk = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in walk:
        if not prim.IsPseudoRoot():
            found.append(prim)
        if prim.IsA(UsdGeom.PointInstancer):
            walk.PruneChildren()
        expected = "one robot: set its prim as the default prim"
        require_size(len(found), MOST_PRIMS, f"prims below {root.GetPath()}", where=str(source), expected=expected)
        require_size(len(schemas(prim)), MOST_SCHEMAS, "schemas", key=str(prim.GetPath()), expected="fewer")
    return found


def _units(usd: Usd.Stage, source: Path) -> Units:
    length, mass = UsdGeom.GetStageMetersPerUnit(usd), UsdPhysics.GetStageKilogramsPerUnit(usd)
    for name, value in (("metersPerUnit", length), ("kilogramsPerUnit", mass)):
        if not (math.isfinite(value) and 1e-9 <= value <= 1e9):
            expected = "a positive number, such as 1 or 0.01"
            raise AssetError(f"the stage's {name} is {value:g}", where=str(source), expected=expected)
    return Units(length, mass, UsdGeom.GetStageUpAxis(usd))


def _note_metadata(stage: Stage) -> None:
    top, ledger, name = stage.usd.GetPseudoRoot(), stage.ledger, stage.source.name
    for key, value in (("metersPerUnit", 0.01), ("upAxis", "Y")):
        if not top.HasAuthoredMetadata(key):
            ledger.assume(name, f"no {key}: USD's fallback", value)
    if stage.units.up not in ("Y", "Z"):
        ledger.assume(name, f"upAxis '{stage.units.up}' is none that USD has", "Z")
    wanted = stage.usd.GetRootLayer().defaultPrim
    if not stage.usd.GetDefaultPrim():
        ledger.assume(name, "no defaultPrim: the whole stage is read", "/")
        if wanted:
            ledger.warn(f"the default prim '{wanted}' does not exist, so the whole stage is read")
    for layer in stage.layers:
        if layer.startswith("../") or Path(layer).is_absolute():
            ledger.assume(name, f"a layer outside the file's folder is read: {layer}", "as the file asks")


def _real_path(layer: Sdf.Layer) -> Path | None:
    """Return the file that holds a layer; one inside a package is held by the package."""
    if layer.anonymous or not layer.realPath:
        return None
    return Path(Ar.SplitPackageRelativePathOuter(layer.realPath)[0])


def _hashes(usd: Usd.Stage, source: Path) -> dict[str, str]:
    folder = source.resolve().parent
    files = {path for layer in usd.GetUsedLayers() if (path := _real_path(layer))}
    return {relative_name(path, folder): file_hash(path) for path in sorted(files)}


def file_hash(path: Path) -> str:
    """Return the sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def relative_name(path: Path, folder: Path) -> str:
    """Return ``path`` as seen from ``folder``, with slashes, climbing out of it where needed."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def below_instancer(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield the prims below a PointInstancer, which ``Stage.prims`` leaves out."""
    walk = iter(Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))
    next(walk)
    yield from walk
