"""Read the colours and friction of USD shapes from bound materials and display colours."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdShade

from wheelleg_exp.asset.rigid_geometry import single
from wheelleg_exp.asset.robot_description import Material, Rgba, unique_names
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas

COLOR_INPUTS = ("diffuseColor", "diffuse_color_constant", "diffuse_tint", "baseColor")


@dataclass
class Looks:
    """The materials of a robot's geoms; ``found`` maps the path of each USD material to the converted material."""

    stage: Stage
    found: dict[str, Material] = field(default_factory=dict)

    def named(self) -> dict[str, Material]:
        """Return the materials of MuJoCo's geoms, with unique names, by the path of the USD material."""
        names = unique_names(self.found)
        return {path: Material(names[path], m.rgba, m.metallic, m.roughness) for path, m in self.found.items()}

    def look(self, prim: Usd.Prim) -> tuple[str | None, Rgba | None]:
        """Return the path of a gprim's bound material; if there is none, return the gprim's display colour instead."""
        bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        if bound and self._read(bound.GetPrim()):
            self.stage.ledger.mapped(prim.GetPath(), "material:binding", "material")
            return str(bound.GetPath()), None
        return None, display_color(prim)

    def _read(self, material: Usd.Prim) -> bool:
        path = str(material.GetPath())
        if path in self.found:
            return True
        for shader in Usd.PrimRange(material):
            color = _input(shader, COLOR_INPUTS)
            if color is None or len(color) != 3:
                continue
            opacity, *_ = _input(shader, ("opacity", "opacity_constant")) or (1.0,)
            metallic = _input(shader, ("metallic", "metallic_constant")) or (None,)
            roughness = _input(shader, ("roughness", "reflection_roughness_constant")) or (None,)
            self.found[path] = Material(path, (color[0], color[1], color[2], opacity), metallic[0], roughness[0])
            return True
        return False


def display_color(prim: Usd.Prim) -> Rgba | None:
    """Return a gprim's first displayColor and displayOpacity as RGBA; None if the value is invalid."""
    gprim = UsdGeom.Gprim(prim)
    color = _first(gprim.GetDisplayColorPrimvar(), 3)
    if color is None:
        return None
    opacity = _first(gprim.GetDisplayOpacityPrimvar(), 1)
    return color[0], color[1], color[2], opacity[0] if opacity else 1.0


def _first(primvar: UsdGeom.Primvar, count: int) -> tuple[float, ...] | None:
    try:
        values = np.asarray(primvar.ComputeFlattened(), dtype=float).reshape(-1, count)
    except (Tf.ErrorException, TypeError, ValueError):
        return None
    if not len(values) or not np.isfinite(values[0]).all():
        return None
    return tuple(single(float(value)) for value in values[0])


def _input(shader: Usd.Prim, names: tuple[str, ...]) -> tuple[float, ...] | None:
    for name in names:
        attribute = shader.GetAttribute(f"inputs:{name}")
        value = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
        if isinstance(value, (float, int)) or (value is not None and len(np.shape(value)) == 1):
            return tuple(single(float(v)) for v in np.atleast_1d(value))
    return None


def physics_material(stage: Stage, prim: Usd.Prim) -> Usd.Prim | None:
    """Return the physics material of a gprim: bound for physics or all purposes, directly, above, or by collection."""
    material, relationship = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
    if not material or "PhysicsMaterialAPI" not in schemas(material.GetPrim()):
        return None
    if relationship:
        stage.ledger.mapped(relationship.GetPrim().GetPath(), relationship.GetName(), "friction and density")
    return material.GetPrim()


def friction_of(stage: Stage, prim: Usd.Prim) -> float | None:
    """Return a collider's friction: its material's, else the scene's, else PhysX's; None: MuJoCo's, for its schemas."""
    # As in PhysX, a shape without its own physics material uses the physics scene's default material.
    defaults = (physics_material(stage, scene) for scene in stage.physics_scenes)
    material = physics_material(stage, prim) or next(filter(None, defaults), None)
    if material is None:
        if any(name.startswith("Mjc") for scene in stage.physics_scenes for name in schemas(scene)):
            return None
        rule = "colliders without a physics material: PhysX's default friction"
        stage.ledger.assume(stage.root.GetPath(), rule, PHYSX_FRICTION)
        return PHYSX_FRICTION
    ledger = stage.ledger
    dynamic = ledger.read(material, "physics:dynamicFriction", "geom friction[0]")
    for name, reason in _NO_PLACE.items():
        value = ledger.read(material, name)
        if value is not None:
            ledger.leave(material.GetPath(), name, reason, value)
    mode = stage.ledger.read(material, "physxMaterial:frictionCombineMode") or "average"
    if mode != "max":
        rule = f"PhysX combines friction by '{mode}', MuJoCo uses the larger"
        stage.ledger.assume(material.GetPath(), rule, "friction as authored")
    return 0.0 if dynamic is None else max(0.0, float(dynamic))


PHYSX_FRICTION = 0.5


_NO_PLACE = {
    "physics:staticFriction": "MuJoCo has one sliding friction: the dynamic one",
    "physics:restitution": "MuJoCo has no coefficient of restitution; solref and solimp define contacts",
}
