"""Goes through everything authored that carries physics, and names what nobody read: properties, schemas, prims."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics

from wheelleg_exp.asset.usd.attributes import plain
from wheelleg_exp.asset.usd.reasons import PHYSICAL_PROPERTIES, PHYSICAL_SCHEMAS, why_kind, why_property, why_schema
from wheelleg_exp.asset.usd.scene import physics_scenes
from wheelleg_exp.asset.usd.stage import Stage, below_instancer, schemas

LONGEST = 200  # characters of a value


def audit(stage: Stage) -> None:
    """Name every authored physics property, applied schema and prim that nothing read."""
    for prim in _everything(stage):
        _kind(stage, prim)
        _schemas(stage, prim)
        if prim.GetTypeName() == "Shader":
            _files(stage, prim)
        group = prim.IsA(UsdPhysics.CollisionGroup)
        for name in prim.GetAuthoredPropertyNames():
            physical = PHYSICAL_PROPERTIES.match(name) or (group and name.startswith("collection:"))
            if physical and not stage.ledger.knows(prim.GetPath(), name):
                prop = prim.GetProperty(name)
                stage.ledger.leave(prim.GetPath(), name, _why(stage, prim, prop), _text(prop))
    _outside(stage)


def _everything(stage: Stage) -> Iterator[Usd.Prim]:
    """Yield the robot's prims, what instancers hide, and what the robot uses from outside: scene and materials."""
    seen: set[Sdf.Path] = set()
    for prim in stage.prims:
        seen.add(prim.GetPath())
        yield prim
        if prim.IsA(UsdGeom.PointInstancer):
            yield from below_instancer(prim)
    for prim in [*physics_scenes(stage), *_materials(stage)]:
        if prim and prim.GetPath() not in seen:
            seen.add(prim.GetPath())
            yield prim


def _materials(stage: Stage) -> Iterator[Usd.Prim]:
    for prim in stage.prims:
        for name in prim.GetAuthoredPropertyNames():
            if name.startswith("material:binding"):
                relationship = prim.GetRelationship(name)
                for path in relationship.GetForwardedTargets() if relationship else []:
                    material = stage.usd.GetPrimAtPath(path) if path.IsPrimPath() else None
                    if material and not material.IsPseudoRoot():
                        yield from Usd.PrimRange(material)


def _kind(stage: Stage, prim: Usd.Prim) -> None:
    kind = str(prim.GetTypeName())
    reason = why_kind(kind)
    if reason and not stage.ledger.knows(path := prim.GetPath(), kind):
        stage.ledger.leave(path, kind, reason.text)
        if reason.loud:
            stage.ledger.warn(f"{path}: a {kind} was left out: {reason.text}")


def _schemas(stage: Stage, prim: Usd.Prim) -> None:
    for name in schemas(prim):
        reason = why_schema(name)
        if reason and not stage.ledger.knows(path := prim.GetPath(), name):
            stage.ledger.leave(path, name, reason.text)
            if reason.loud:
                stage.ledger.warn(f"{path}: {name} was left out: {reason.text}")


def _files(stage: Stage, shader: Usd.Prim) -> None:
    """Name the textures and material libraries of a shader, and say which of them are not there."""
    for name in shader.GetAuthoredPropertyNames():
        value = shader.GetAttribute(name).Get() if name.startswith(("inputs:", "info:mdl")) else None
        if isinstance(value, Sdf.AssetPath) and value.path:
            reason = "colours are carried over, textures and material libraries are not"
            missing = "" if value.resolvedPath else "; this file is not there"
            stage.ledger.leave(shader.GetPath(), name, reason + missing, value.path)


_MASS = ("physics:mass", "physics:density", "physics:centerOfMass", "physics:diagonalInertia", "physics:principalAxes")


def _why(stage: Stage, prim: Usd.Prim, prop: Usd.Property) -> str:
    """Return why a property was left out, from where it stands where that says more than its name."""
    name, kind = prop.GetName(), str(prim.GetTypeName())
    if isinstance(prop, Usd.Attribute) and not prop.HasAuthoredValue():
        return "declared without a value"
    if name in _MASS:
        return _why_mass(prim, name)
    joint = prim.IsA(UsdPhysics.Joint)
    if joint and stage.ledger.left_out(prim.GetPath(), kind):
        return "its joint was left out"
    if joint and not stage.ledger.knows(prim.GetPath(), kind):
        return "its joint says nothing here"
    if name == "newton:inertia":
        return "zeros, which mean not given" if "PhysicsRigidBodyAPI" in schemas(prim) else "it counts on bodies alone"
    if name.startswith(("drive:", "limit:", "state:")) and ":physics:" in name:
        return "the joint leaves no such axis free" if joint else "only joints have drives, limits and states"
    if joint and name.startswith(("physics:lower", "physics:upper", "physics:cone", "physics:axis")):
        return "this joint has no such limit or axis"
    return why_property(name)


def _why_mass(prim: Usd.Prim, name: str) -> str:
    applied = schemas(prim)
    if "PhysicsRigidBodyAPI" in applied:
        return "not needed beside the others" if name == "physics:density" else "it means not given: 0 or not finite"
    if "PhysicsCollisionAPI" in applied:
        return "it means not given, or the body that it would weigh in has mass properties of its own"
    if "PhysicsMaterialAPI" in applied:
        return "not needed: what it would weigh has a mass, or nothing is bound to it"
    return "mass properties count on bodies, colliders and materials alone"


def _text(prop: Usd.Property) -> str:
    try:
        if isinstance(prop, Usd.Relationship):
            return ", ".join(str(path) for path in prop.GetTargets())[:LONGEST]
        if not isinstance(prop, Usd.Attribute):  # a damaged layer names it, and holds nothing of it
            return "not readable"
        value = plain(prop.Get()) if prop.HasAuthoredValue() else ""
    except Tf.ErrorException:  # authored as an attribute in one layer and as a relationship in another
        return "not readable"
    return " ".join(str(value).split())[:LONGEST]


def _outside(stage: Stage) -> None:
    """Name the physics that stands outside the default prim, one entry for each prim at the top."""
    top = stage.root.GetPath().GetPrefixes()[:1]
    if not top:
        return
    used = _referenced(stage)
    for prim in stage.usd.GetPseudoRoot().GetChildren():
        if prim.GetPath() in (*top, *used) or prim.IsA(UsdPhysics.Scene):
            continue
        found = Counter(_sort(inner) for inner in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))
        parts = [f"{sort}: {found[sort]}" for sort in ("bodies", "joints", "colliders") if found[sort]]
        if parts:
            reason = f"it stands outside the default prim {stage.root.GetPath()}"
            stage.ledger.leave(prim.GetPath(), str(prim.GetTypeName()) or "prim", reason, ", ".join(parts))


def _sort(prim: Usd.Prim) -> str:
    if prim.IsA(UsdPhysics.Joint):
        return "joints"
    applied = [name for name in schemas(prim) if PHYSICAL_SCHEMAS.match(name)]
    return "bodies" if "PhysicsRigidBodyAPI" in applied else "colliders" if "PhysicsCollisionAPI" in applied else ""


def _referenced(stage: Stage) -> set[Sdf.Path]:
    """Return the prims at the top that the robot is made of by reference, such as scopes of prototypes."""
    found: set[Sdf.Path] = set()
    for prim in stage.prims:
        if prim.IsInstance() or prim.HasAuthoredReferences():
            nodes = [prim.GetPrimIndex().rootNode]
            while nodes:
                node = nodes.pop()
                nodes += node.children
                found |= set(node.path.GetPrefixes()[:1])
    return found
