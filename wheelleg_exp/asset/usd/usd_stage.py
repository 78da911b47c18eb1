"""Open a USD file, select its variants, list the robot's prims, and read units, transforms, and the physics scene."""

from __future__ import annotations

import hashlib
import itertools
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeGuard

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from wheelleg_exp.asset.file_limits import MOST_PRIMS, require_near, require_plain_file, require_size
from wheelleg_exp.asset.rigid_geometry import Array, Frame, rigid_part, rounded, single, vec3
from wheelleg_exp.asset.robot_description import Vec3
from wheelleg_exp.asset.usd.ledger import Ledger
from wheelleg_exp.asset.usd.usd_layers import find_missing, open_layers, require_physics
from wheelleg_exp.errors import AssetError, nearest_name

HUGE = 1e37
ENDLESS_DEG = 5e7  # degrees
ENDLESS_LENGTH = 1e6


@dataclass(frozen=True)
class Units:
    """Metres per unit, kilograms per unit, and up axis of a stage; the methods convert numbers to SI units."""

    meters: float
    kilograms: float
    up: str

    def world(self) -> Array:
        """Return the 4x4 map from stage coordinates to metres with z up (y up: +90° about x)."""
        out = np.eye(4)
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if self.up == "Y" else np.eye(3)
        out[:3, :3] = turn * self.meters
        return out

    def mass(self, value: float) -> float:
        return value * self.kilograms

    def density(self, value: float) -> float:
        return value * self.kilograms / self.meters**3

    def inertia(self, value: float) -> float:
        return value * self.kilograms * self.meters**2

    def coordinate(self, value: float, angular: bool) -> float:
        """Convert a joint coordinate or velocity, in degrees or stage lengths."""
        return rounded(math.radians(value) if angular else value * self.meters)

    def effort(self, value: float, angular: bool) -> float:
        return rounded(value * self.kilograms * self.meters ** (2 if angular else 1))

    def gain(self, value: float, angular: bool) -> float:
        """Convert a stiffness or damping, per degree or per stage length."""
        if angular:
            return rounded(math.degrees(value) * self.kilograms * self.meters**2)
        return rounded(value * self.kilograms)

    def rotor(self, value: float, angular: bool) -> float:
        """Convert a joint's armature."""
        return rounded(self.inertia(value) if angular else self.mass(value))


def given(value: float | None) -> TypeGuard[float]:
    """Return whether a mass or density is given: authored, finite, and positive."""
    return value is not None and value > 0 and math.isfinite(value)


def endless(value: float | None, angular: bool) -> bool:
    """Return whether a limit in degrees or stage lengths means unlimited: missing, infinite, or huge."""
    if value is None or not math.isfinite(value):
        return True
    return abs(value) >= (ENDLESS_DEG if angular else ENDLESS_LENGTH)


def effort_limit(value: float | None) -> float | None:
    """Return the effort limit ``value`` (USD stage units); None if it is missing, infinite, huge, or not positive."""
    return None if value is None or not math.isfinite(value) or value >= HUGE or value <= 0 else value


def choose(usd: Usd.Stage, variants: Mapping[str, str]) -> dict[str, str]:
    """Select each USD variant on the first prim with its set; return the selected variant of each variant set."""
    root = usd.GetDefaultPrim() or usd.GetPseudoRoot()
    usd.SetEditTarget(usd.GetSessionLayer())
    chosen = {}
    for name, wanted in variants.items():
        key = f"--variant {name}={wanted}"
        holders = [prim for prim in Usd.PrimRange(root) if name in prim.GetVariantSets().GetNames()]
        if not holders:
            known = list(variant_sets(root))
            expected = "one of " + ", ".join(known) if known else "no variants: the file has none"
            nearest = nearest_name(name, known)
            raise AssetError(f"there is no variant set '{name}'", key=key, expected=expected, nearest=nearest)
        options = holders[0].GetVariantSet(name).GetVariantNames()
        if wanted not in options:
            message, expected = f"variant set '{name}' has no variant '{wanted}'", "one of " + ", ".join(options)
            raise AssetError(message, key=key, expected=expected, nearest=nearest_name(wanted, options))
        holders[0].GetVariantSet(name).SetVariantSelection(wanted)
        chosen[name] = wanted
    sets = root.GetVariantSets()
    return {**chosen, **{name: sets.GetVariantSelection(name) for name in sorted(sets.GetNames())}}


def variant_sets(root: Usd.Prim) -> dict[str, list[str]]:
    """Map each USD variant set at or below the prim ``root`` to its variant names; the sets of ``root`` come first."""
    found: dict[str, list[str]] = {}
    for prim in Usd.PrimRange(root):
        for name in prim.GetVariantSets().GetNames():
            found.setdefault(name, list(prim.GetVariantSet(name).GetVariantNames()))
    return found


SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


@dataclass
class Stage:
    """An open stage and shared data of the readers: units, the prims to read, transforms, and the ledger.

    ``prims`` are in the stage's order, without the prims below a PointInstancer, because USD does not draw prototypes.
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

    @cached_property
    def physics_scenes(self) -> list[Usd.Prim]:
        """The PhysicsScene prims of a USD stage, in the stage's order."""
        return [prim for prim in self.usd.Traverse() if prim.IsA(UsdPhysics.Scene)]

    @cached_property
    def articulation_prims(self) -> list[Sdf.Path]:
        return [prim.GetPath() for prim in self.prims if "PhysicsArticulationRootAPI" in schemas(prim)]

    def of_type(self, kind: str) -> list[Usd.Prim]:
        """Return the prims of a USD type, such as ``MjcTendon``."""
        return [prim for prim in self.prims if prim.GetTypeName() == kind]

    def matrix(self, prim: Usd.Prim | None) -> Array:
        """Return the 4x4 map from a prim's coordinates (None: the stage's) to the world in metres, z up."""
        if prim is None:
            return self._world
        try:
            local = np.array(self._xforms.GetLocalToWorldTransform(prim), dtype=float).T
        except Tf.ErrorException as error:
            expected = "xformOps of this prim, each with its own type"
            raise AssetError(_complaint(error), key=str(prim.GetPath()), expected=expected) from None
        with np.errstate(all="ignore"):
            out = np.asarray(self._world @ local)
        require_near(out, key=str(prim.GetPath()))
        return out

    def frame(self, prim: Usd.Prim) -> Frame:
        """Return the rigid frame of a prim in the world, without scale."""
        return rigid_part(self.matrix(prim))


def schemas(prim: Usd.Prim) -> list[str]:
    """Return the names of the API schemas applied to a USD prim, even of schemas that the USD library does not know."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


def open_stage(source: Path, variants: Mapping[str, str]) -> Stage:
    """Open the USD file ``source`` with all payloads loaded."""
    expected = "a USD file (" + ", ".join(SUFFIXES) + ")"
    require_plain_file(source, expected)
    if source.suffix.lower() not in SUFFIXES:
        raise AssetError(f"'{source.name}' is not a USD file", where=str(source), expected=", ".join(SUFFIXES))
    if not source.stat().st_size:
        raise AssetError(f"'{source.name}' is empty", where=str(source), expected=expected)
    with library(source):
        root, *_ = open_layers(source)
        usd = Usd.Stage.Open(root, Usd.Stage.LoadAll)
        # Set USD attributes that have only time samples to their first sample, without a change of the USD file.
        sampled = []
        for layer in usd.GetUsedLayers():
            if not layer.ListAllTimeSamples():
                continue
            paths: list[Sdf.Path] = []
            layer.Traverse("/", paths.append)
            for path in filter(Sdf.Path.IsPropertyPath, paths):
                spec = layer.GetAttributeAtPath(path)
                times = layer.ListTimeSamplesForPath(path) if spec and not spec.HasDefaultValue() else []
                value = layer.QueryTimeSample(path, times[0]) if times else None
                if value is not None and not isinstance(value, Sdf.ValueBlock):
                    spec.default = value
                    sampled.append(str(path))
        chosen = choose(usd, variants)
        stage = _collect(usd, source, chosen)
        for path in sampled:
            stage.ledger.assume(path, "only time samples, no default: the first one", "the stage at its start")
        return stage


@contextmanager
def library(source: Path) -> Iterator[None]:
    """Hide the USD library's terminal messages, and convert USD errors and OSError to AssetError."""
    # The diagnostic delegate collects the messages that the USD library would otherwise print to stderr.
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    except Tf.ErrorException as error:
        raise _unreadable(source, error) from None
    except UnicodeDecodeError:
        expected = "UTF-8"
        raise AssetError(f"'{source.name}' contains invalid text", where=str(source), expected=expected) from None
    except OSError as error:
        raise AssetError(f"cannot be read: {error.strerror}", key=str(error.filename or source)) from None
    finally:
        delegate.TakeUncoalescedDiagnostics()


def _unreadable(source: Path, error: Tf.ErrorException) -> AssetError:
    """Return an AssetError with the USD library's first error message and, for a text layer, the line of the error."""
    text = _complaint(error)
    place = re.search(r"(\S+?):(\d+):(\d+): .*?(Expected .*?)?at (.*)$", text)
    if place is None:
        expected = "a whole USD layer, text or crate"
        return AssetError(f"'{source.name}' cannot be read: {text}", where=str(source), expected=expected)
    path, line, _, expected, found = place.groups()
    message, where = f"'{source.name}' cannot be read: something is wrong at {found.strip()[:200]}", f"{path}:{line}"
    expected = expected.removeprefix("Expected ").strip() if expected else "a valid USD layer"
    return AssetError(message, where=where, expected=expected)


def _complaint(error: Tf.ErrorException) -> str:
    """Return the USD library's first error message, without the file and line of the library's source code."""
    first = str(error).strip().split("Error in ")[1:2] or [str(error)]
    text = " ".join(first[0].split(" : ", 1)[-1].split()).strip("' ")
    return text if len(text) <= 300 else text[:300] + "..."


def _collect(usd: Usd.Stage, source: Path, variants: dict[str, str]) -> Stage:
    root = usd.GetDefaultPrim() or usd.GetPseudoRoot()
    prims = []
    walk = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in walk:
        if not prim.IsPseudoRoot():
            prims.append(prim)
        # Skip the prims below a USD PointInstancer, because they are prototypes, which USD does not draw.
        if prim.IsA(UsdGeom.PointInstancer):
            walk.PruneChildren()
        expected = "one robot: set its prim as the default prim"
        require_size(len(prims), MOST_PRIMS, f"prims below {root.GetPath()}", where=str(source), expected=expected)
    length, mass = UsdGeom.GetStageMetersPerUnit(usd), UsdPhysics.GetStageKilogramsPerUnit(usd)
    for name, value in (("metersPerUnit", length), ("kilogramsPerUnit", mass)):
        if not (math.isfinite(value) and 1e-9 <= value <= 1e9):
            expected = "a positive number, such as 1 or 0.01"
            raise AssetError(f"the USD unit {name} = {value:g} is invalid", where=str(source), expected=expected)
    missing = find_missing(usd, source)
    require_physics(usd, prims, missing, source)
    names = tuple(item.name for item in missing)
    units = Units(length, mass, UsdGeom.GetStageUpAxis(usd))
    stage = Stage(usd, source, units, root, prims, _hashes(usd, source), names, variants)
    for item in missing:
        what = "not found" if item.is_file else f"{item.prims[0]}: not found or a cycle"
        stage.ledger.warn(f"{what}, read without it: {item.name}")
        stage.ledger.find("layer_not_found", item.name, item.prims[0], places=len(item.prims), looks=item.looks_only)
    for name, options in variant_sets(root).items():  # USD ignores all variants of a variant set without a selection.
        holder = next(prim for prim in Usd.PrimRange(root) if name in prim.GetVariantSets().GetNames())
        if options and not holder.GetVariantSet(name).GetVariantSelection():
            hint = f"--variant {name}=NAME takes one of {', '.join(options)}"
            stage.ledger.warn(f"{holder.GetPath()}: no variant of '{name}' is selected; {hint}")
    top, ledger, name = stage.usd.GetPseudoRoot(), stage.ledger, stage.source.name
    for key, value in (("metersPerUnit", 0.01), ("upAxis", "Y")):
        if not top.HasAuthoredMetadata(key):
            ledger.assume(name, f"no {key}: USD's fallback", value)
    if stage.units.up not in ("Y", "Z"):
        ledger.assume(name, f"upAxis '{stage.units.up}' is not an axis of USD", "Z")
    wanted = stage.usd.GetRootLayer().defaultPrim
    if not stage.usd.GetDefaultPrim():
        ledger.assume(name, "no defaultPrim: the whole stage is read", "/")
        if wanted:
            ledger.warn(f"the default prim '{wanted}' does not exist, so the whole stage is read")
    for layer in stage.layers:
        if layer.startswith("../") or Path(layer).is_absolute():
            ledger.assume(name, f"a layer outside the file's folder is read: {layer}", "as the file asks")
    return stage


def _hashes(usd: Usd.Stage, source: Path) -> dict[str, str]:
    folder = source.resolve().parent
    paths = [layer.realPath for layer in usd.GetUsedLayers() if layer.realPath and not layer.anonymous]
    files = {Path(Ar.SplitPackageRelativePathOuter(path)[0]) for path in paths}
    return {relative_name(path, folder): file_hash(path) for path in sorted(files)}


def file_hash(path: Path) -> str:
    """Return the sha256 hash of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def relative_name(path: Path, folder: Path) -> str:
    """Return ``path`` relative to ``folder``, with ``..`` if needed, and with slashes on every platform."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def scene_of_robot(stage: Stage) -> Usd.Prim | None:
    """Return the PhysicsScene that the bodies name as simulation owner; otherwise the first scene, or None."""
    scenes = stage.physics_scenes
    if len(scenes) < 2:
        return scenes[0] if scenes else None
    paths = {scene.GetPath(): scene for scene in scenes}
    for prim in stage.prims:
        for target in stage.ledger.targets(prim, "physics:simulationOwner"):
            if target in paths:
                stage.ledger.mapped(prim.GetPath(), "physics:simulationOwner", "the choice of the scene")
                return paths[target]
    return scenes[0]


EARTH = 9.81


def gravity(stage: Stage) -> Vec3:
    """Return the gravity vector in m/s², z up, of the robot's PhysicsScene; earth's gravity if there is no scene."""
    scene = scene_of_robot(stage)
    if scene is None:
        stage.ledger.assume(stage.source.name, "no PhysicsScene: gravity", f"{EARTH} m/s² downwards")
        return 0.0, 0.0, -EARTH
    for other in stage.physics_scenes:
        if other != scene:
            stage.ledger.leave(other.GetPath(), "PhysicsScene", f"one scene is read: {scene.GetPath()}")
    stage.ledger.mapped(scene.GetPath(), "PhysicsScene", "option gravity")
    if stage.ledger.read(scene, "newton:gravityEnabled", "option gravity") is False:
        stage.ledger.assume(scene.GetPath(), "newton:gravityEnabled is off", "no gravity")
        return 0.0, 0.0, 0.0
    size = stage.ledger.read(scene, "physics:gravityMagnitude", "option gravity")
    direction = stage.ledger.read(scene, "physics:gravityDirection", "option gravity")
    given = size is not None and size >= 0 and math.isfinite(size)
    metres = single(size * stage.units.meters) if given else EARTH
    if direction is None or not any(direction):
        return 0.0, 0.0, -metres
    turned = stage.units.world()[:3, :3] @ np.array(direction)
    return vec3(metres * turned / np.linalg.norm(turned))


def find_scene(stage: Stage) -> Usd.Prim | None:
    """Return MuJoCo's scene: the first PhysicsScene with MjcSceneAPI."""
    top = stage.usd.GetPseudoRoot()
    prims = itertools.chain(top.GetChildren(), Usd.PrimRange(top))
    return next((p for p in prims if p.IsA(UsdPhysics.Scene) and "MjcSceneAPI" in schemas(p)), None)


def angle_in_radians(stage: Stage, value: float) -> float:
    """Convert an angle of MuJoCo's USD schemas to rad, from the unit in ``mjc:compiler:angle`` (default: degrees)."""
    scene = find_scene(stage)
    unit = stage.ledger.read(scene, "mjc:compiler:angle", "the unit of mjc:ref and mjc:springref") if scene else None
    return value if unit == "radian" else math.radians(value)
