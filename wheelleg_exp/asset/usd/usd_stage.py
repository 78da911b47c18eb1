"""Open a USD file, choose its variants, and list the robot's prims; units, transforms, and the physics scene."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from wheelleg_exp.asset.file_limits import FARTHEST, FETCH, MOST_PRIMS, POINTER, require_plain_file, require_size
from wheelleg_exp.asset.rigid_geometry import Array, Frame, rigid_part, rounded, single, vec3
from wheelleg_exp.asset.robot_description import Vec3
from wheelleg_exp.asset.usd.ledger import Ledger
from wheelleg_exp.asset.usd.usd_layers import Missing, find_missing, open_layers, require_physics
from wheelleg_exp.errors import AssetError, nearest_name

HUGE = 1e37  # larger numbers mean infinity
ENDLESS_DEG = 5e7  # importers write a continuous hinge as ±57295776° (1e6 rad) or ±1e8°
ENDLESS_LENGTH = 1e6


@dataclass(frozen=True)
class Units:
    """Factors of a stage: metres per unit, kilograms per unit, and the up axis."""

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
        """Return kg."""
        return value * self.kilograms

    def density(self, value: float) -> float:
        """Return kg/m³."""
        return value * self.kilograms / self.meters**3

    def inertia(self, value: float) -> float:
        """Return kg·m²."""
        return value * self.kilograms * self.meters**2

    def coordinate(self, value: float, angular: bool) -> float:
        """Return a joint coordinate or speed in rad or m, from degrees or stage lengths."""
        return rounded(math.radians(value) if angular else value * self.meters)

    def effort(self, value: float, angular: bool) -> float:
        """Return N·m or N."""
        return rounded(value * self.kilograms * self.meters ** (2 if angular else 1))

    def gain(self, value: float, angular: bool) -> float:
        """Return a stiffness or damping per rad or per m, from one per degree or per stage length."""
        if angular:
            return rounded(math.degrees(value) * self.kilograms * self.meters**2)
        return rounded(value * self.kilograms)

    def rotor(self, value: float, angular: bool) -> float:
        """Return an armature in kg·m² or kg."""
        return rounded(self.inertia(value) if angular else self.mass(value))


def given(value: float | None) -> bool:
    """Return whether a mass or density is given: authored, finite, and positive."""
    return value is not None and value > 0 and math.isfinite(value)


def endless(value: float | None, angular: bool) -> bool:
    """Return whether a limit in degrees or stage lengths means unlimited: missing, infinite, or huge."""
    if value is None or not math.isfinite(value):
        return True
    return abs(value) >= (ENDLESS_DEG if angular else ENDLESS_LENGTH)


def effort_limit(value: float | None) -> float | None:
    """Return a drive's force limit in stage units, None if missing, infinite, huge, or not positive."""
    if value is None or not math.isfinite(value) or value >= HUGE or value <= 0:
        return None
    return value


def choose(usd: Usd.Stage, variants: Mapping[str, str]) -> dict[str, str]:
    """Select variants on the stage's session layer. Return all selected names by variant set.

    Variant sets are searched on the default prim first, then below it.

    Raises:
        AssetError: the variant set does not exist, or has no such variant.
    """
    root = usd.GetDefaultPrim() or usd.GetPseudoRoot()
    usd.SetEditTarget(usd.GetSessionLayer())
    chosen = {}
    for name, wanted in variants.items():
        holders = [prim for prim in Usd.PrimRange(root) if name in prim.GetVariantSets().GetNames()]
        if not holders:
            known = list(variant_sets(root))
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
        chosen[name] = wanted
    sets = root.GetVariantSets()
    return {**chosen, **{name: sets.GetVariantSelection(name) for name in sorted(sets.GetNames())}}


def unselected(root: Usd.Prim) -> Iterator[str]:
    """Yield a warning for each variant set without a selection, whose variants are all ignored."""
    for name, options in variant_sets(root).items():
        holder = next(prim for prim in Usd.PrimRange(root) if name in prim.GetVariantSets().GetNames())
        if options and not holder.GetVariantSet(name).GetVariantSelection():
            hint = f"--variant {name}=NAME takes one of {', '.join(options)}"
            yield f"{holder.GetPath()}: no variant of '{name}' is selected; {hint}"


def variant_sets(root: Usd.Prim) -> dict[str, list[str]]:
    """Return the variants by variant set: sets of ``root`` first, then those below it."""
    found: dict[str, list[str]] = {}
    for prim in Usd.PrimRange(root):
        for name in prim.GetVariantSets().GetNames():
            found.setdefault(name, list(prim.GetVariantSet(name).GetVariantNames()))
    return found


SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MOST_SCHEMAS = 200  # of one prim; the library's time grows with the square of their number


@dataclass
class Stage:
    """An open stage and shared data of the readers: units, the prims to read, transforms, and the ledger.

    ``prims`` are in the stage's order, without the prims below a PointInstancer, which are drawn only as its instances.
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
        """All PhysicsScene prims of the stage."""
        return [prim for prim in self.usd.Traverse() if prim.IsA(UsdPhysics.Scene)]

    @cached_property
    def articulation_prims(self) -> list[Sdf.Path]:
        """The prims that carry ArticulationRootAPI."""
        return [prim.GetPath() for prim in self.prims if "PhysicsArticulationRootAPI" in schemas(prim)]

    def matrix(self, prim: Usd.Prim | None) -> Array:
        """Return the 4x4 map from a prim's coordinates (None: the stage's) to the world in metres, z up.

        Raises:
            AssetError: an xformOp is invalid or not finite, or moves the prim farther than any robot reaches.
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
    """Return the applied API schemas as authored, including those unknown to the USD library."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


def open_stage(source: Path, variants: Mapping[str, str]) -> Stage:
    """Open ``source`` with all payloads loaded.

    Raises:
        AssetError: the file is missing or not USD, a variant does not exist, a physics layer is missing, or the stage
            is too large for a robot.
    """
    _require_file(source)
    with library(source):
        root, *_ = open_layers(source)  # the stage uses the other layers, which stay open
        usd = Usd.Stage.Open(root, Usd.Stage.LoadAll)
        sampled = _settle_samples(usd)
        chosen = choose(usd, variants)
        stage = _collect(usd, source, chosen)
        for path in sampled:
            stage.ledger.assume(path, "only time samples, no default: the first one", "the stage at its start")
        return stage


@contextmanager
def library(source: Path) -> Iterator[None]:
    """Hide the USD library's terminal messages, and convert its errors and those of the disk to AssetError.

    Raises:
        AssetError: the library cannot read the file or a layer.
    """
    # The delegate collects the library's messages, which would otherwise go to stderr.
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
    """Return the library's first error: for a text layer with its line and the text there."""
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
    """Return the library's first error, without its place in the library's code."""
    first = str(error).strip().split("Error in ")[1:2] or [str(error)]
    text = " ".join(first[0].split(" : ", 1)[-1].split()).strip("' ")
    return text if len(text) <= 300 else text[:300] + "..."


def _settle_samples(usd: Usd.Stage) -> list[str]:
    """Set attributes that have only time samples to their first sample, in memory; return their paths.

    All attributes are read at the default time, where such an attribute has no value.
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
        stage.ledger.warn(_missing_text(item))
        stage.ledger.find("layer_not_found", item.name, item.prim, places=len(item.prims), looks=item.looks_only)
    for text in unselected(root):
        stage.ledger.warn(text)
    _note_metadata(stage)
    return stage


def _missing_text(item: Missing) -> str:
    if not item.is_file:
        return f"{item.prim}: not found or a cycle, read without it: {item.name}"
    return f"not found, read without it: {item.name}"


def _prims(root: Usd.Prim, source: Path) -> list[Usd.Prim]:
    found = []
    walk = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in walk:
        if not prim.IsPseudoRoot():
            found.append(prim)
        # Prototypes below an instancer are not drawn themselves, only their instances.
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
        ledger.assume(name, f"upAxis '{stage.units.up}' is not an axis of USD", "Z")
    wanted = stage.usd.GetRootLayer().defaultPrim
    if not stage.usd.GetDefaultPrim():
        ledger.assume(name, "no defaultPrim: the whole stage is read", "/")
        if wanted:
            ledger.warn(f"the default prim '{wanted}' does not exist, so the whole stage is read")
    for layer in stage.layers:
        if layer.startswith("../") or Path(layer).is_absolute():
            ledger.assume(name, f"a layer outside the file's folder is read: {layer}", "as the file asks")


def _real_path(layer: Sdf.Layer) -> Path | None:
    """Return the file of a layer; a layer inside a package belongs to the package's file."""
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
    """Return ``path`` relative to ``folder``, with slashes and ``..`` if needed."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def below_instancer(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield the prims below a PointInstancer, which ``Stage.prims`` leaves out."""
    walk = iter(Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))
    next(walk)
    yield from walk


def scene_of_robot(stage: Stage) -> Usd.Prim | None:
    """Return the scene that the bodies name as their owner, else the first scene, else None."""
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
    """Return gravity in m/s², z up, of the robot's PhysicsScene; the earth's without a scene."""
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
    return _vector(stage, scene)


def _vector(stage: Stage, scene: Usd.Prim) -> Vec3:
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
    near: Iterable[Usd.Prim] = top.GetChildren()
    for prims in (near, Usd.PrimRange(top)):
        for prim in prims:
            if prim.IsA(UsdPhysics.Scene) and "MjcSceneAPI" in schemas(prim):
                return prim
    return None


def angle_in_radians(stage: Stage, value: float) -> float:
    """Return an angle of MuJoCo's schemas in rad. The scene's compiler sets its unit: degrees by default, or radian."""
    scene = find_scene(stage)
    unit = stage.ledger.read(scene, "mjc:compiler:angle", "the unit of mjc:ref and mjc:springref") if scene else None
    return value if unit == "radian" else math.radians(value)
