"""Reads colours and friction from bound materials and display colours."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from wheelleg_exp.asset.description import Material, Rgba
from wheelleg_exp.asset.geometry import single
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.reader.stage import Stage, schemas

COLOR_INPUTS = ("diffuseColor", "diffuse_color_constant", "diffuse_tint", "baseColor")


@dataclass
class Looks:
    """Materials met so far, by path of the USD material, in the order of meeting."""

    stage: Stage
    found: dict[str, Material] = field(default_factory=dict)

    def named(self) -> dict[str, Material]:
        """Return the materials with names that tell them apart, by USD path."""
        names = unique_names(self.found)
        return {path: Material(names[path], m.rgba, m.metallic, m.roughness) for path, m in self.found.items()}

    def look(self, prim: Usd.Prim) -> tuple[str | None, Rgba | None]:
        """Return the path of the material that colours a gprim, or the gprim's own colour."""
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
            opacity = _input(shader, ("opacity", "opacity_constant"))
            self.found[path] = Material(
                path,
                (color[0], color[1], color[2], 1.0 if opacity is None else opacity),
                _input(shader, ("metallic", "metallic_constant")),
                _input(shader, ("roughness", "reflection_roughness_constant")),
            )
            return True
        return False


def display_color(prim: Usd.Prim) -> Rgba | None:
    """Return a gprim's first displayColor, with displayOpacity."""
    gprim = UsdGeom.Gprim(prim)
    colors = gprim.GetDisplayColorPrimvar().ComputeFlattened()
    if not colors:
        return None
    opacity = gprim.GetDisplayOpacityPrimvar().ComputeFlattened()
    r, g, b = (single(float(c)) for c in colors[0])
    return r, g, b, single(float(opacity[0])) if opacity else 1.0


def _input(shader: Usd.Prim, names: tuple[str, ...]) -> Any:
    for name in names:
        attribute = shader.GetAttribute(f"inputs:{name}")
        value = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
        if isinstance(value, (float, int)):
            return single(float(value))
        if value is not None and len(np.shape(value)) == 1:
            return tuple(single(float(v)) for v in value)
    return None


def friction_of(stage: Stage, prim: Usd.Prim) -> float | None:
    """Return the dynamic friction of the physics material bound to a gprim, None when none is bound."""
    bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
    if not bound or "PhysicsMaterialAPI" not in schemas(bound.GetPrim()):
        return None
    material, ledger = bound.GetPrim(), stage.ledger
    dynamic = ledger.read(material, "physics:dynamicFriction", "geom friction[0]")
    for name, reason in _NO_PLACE.items():
        value = ledger.read(material, name)
        if value is not None:
            ledger.leave(material.GetPath(), name, reason, value)
    _combine(stage, material)
    return 0.0 if dynamic is None else float(dynamic)


_NO_PLACE = {
    "physics:staticFriction": "MuJoCo has one sliding friction: the dynamic one",
    "physics:restitution": "MuJoCo has no coefficient of restitution; contacts are solref and solimp",
}


def _combine(stage: Stage, material: Usd.Prim) -> None:
    mode = stage.ledger.read(material, "physxMaterial:frictionCombineMode") or "average"
    if mode != "max":
        rule = f"PhysX combines friction by '{mode}', MuJoCo takes the larger"
        stage.ledger.assume(material.GetPath(), rule, "friction as authored")
