"""Report every physics property, schema, and prim that is not read, with the reason of the first pattern that fits."""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Tf, Usd, UsdPhysics

from wheelleg_exp.asset.usd.ledger import plain
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas

PHYSICAL_PROPERTIES = re.compile(
    r"physics:|physx|drive:|limit:|state:|newton:|mjc:|mjcf:|urdf:|isaac:physics|omni:physx|warpSim:"
    r"|material:binding:(physics|collection:physics)"
)
PHYSICAL_SCHEMAS = re.compile(r"(TensorPhysics|Physics|Physx|Newton|Mjc|Isaac\w*(Joint|Link|Robot)|warp)\w*API")


@dataclass(frozen=True)
class Reason:
    """Why the MJCF omits a USD schema or prim; if ``loud`` is true, the converter warns the user of the omission."""

    text: str
    loud: bool = False


_PROPERTIES: tuple[tuple[str, str], ...] = (
    (r"physxArticulation:solver", "solver iterations of PhysX; MuJoCo's solver has its own"),
    (r"physxScene:", "a setting of PhysX's own solver"),
    (r"physxArticulation:", "a setting of PhysX's articulations"),
    (r"physxRigidBody:", "a setting of PhysX's bodies: solver, sleep, damping or velocity limits"),
    (r"physxCollision:", "contact and rest offsets of PhysX"),
    (r"physx(ConvexHull|ConvexDecomposition|TriangleMesh|SDF|SphereFill|CookedData)", "PhysX's mesh cooking"),
    (r"physxLimit:", "soft limits of PhysX"),
    (r"physxJoint:jointFriction", "a coefficient of joint force, not a friction torque"),
    (r"physxJoint:", "a setting of PhysX's joints"),
    (r"physxMaterial:", "PhysX's own contact model"),
    (r"physxTendon", "a tendon of PhysX is not supported"),
    (r"physxVehicle", "vehicles of PhysX are not supported"),
    (r"physxForce:", "a constant force; forces come from the task"),
    (r"physxSurfaceVelocity:", "MuJoCo has no conveyors"),
    (r"physics:break(Force|Torque)", "joints never break in MuJoCo"),
    (r"physics:JointEquivalentInertia", "a note of the importer, not physics"),
    (r"physics:startsAsleep", "MuJoCo's bodies start awake"),
    (r"physics:(velocity|angularVelocity|linearVelocity)", "only a floating body has a saved velocity"),
    (r"physics:simulationOwner", "there is one simulation"),
    (r"physics:(engine|tensor:|newton:)", "a note of the simulator that wrote the file"),
    (r"physics:(static|dynamic)Friction|physics:restitution", "no collider is bound to this material"),
    (r"physics:gravity", "zero or negative, which means not given"),
    (r"physics:approximation", "only meshes are approximated"),
    (r"state:\w+:physics:appliedForce", "the force on a joint when the file was saved"),
    (r"isaac:physics", "Isaac's own index of links and joints; they are read from the prims"),
    (r"material:binding:", "no collider of the robot takes its friction from this binding"),
    (r"urdf:", "a note of the converter that wrote the file"),
    (r"newton:(massModel|shellThickness)|mjc:(shell)?inertia", "not needed: the mass is given, or the shape is solid"),
    (r"newton:", "a setting of Newton's solvers"),
    (r"mjcf:", "a note of the importer, not physics"),
    (r"mjc:", "this MuJoCo attribute is not supported yet"),
    (r"physx|omni:physx|warpSim:", "a setting of another simulator"),
)

_SCHEMAS: tuple[tuple[str, Reason], ...] = (
    (r"PhysicsCollisionAPI", Reason("no shape at it or below it collides", loud=True)),
    (r"PhysicsRigidBodyAPI", Reason("it is switched off, or not a body of the robot")),
    (r"PhysicsArticulationRootAPI", Reason("its prim has no joints")),
    (r"PhysxForceAPI", Reason("a constant force; forces come from the task", loud=True)),
    (r"PhysxSurfaceVelocityAPI", Reason("MuJoCo has no conveyors", loud=True)),
    (r"PhysxTrigger\w*API", Reason("triggers call scripts of Isaac Sim")),
    (r"PhysxTendon\w*API", Reason("tendons of PhysX are not supported", loud=True)),
    (r"PhysxMimicJointAPI", Reason("this coupling of joints is not supported", loud=True)),
    (r"PhysxVehicle\w*API", Reason("vehicles of PhysX are not supported", loud=True)),
    (r"Physx(Particle|PBD|Diffuse)\w*API", Reason("particles are not supported", loud=True)),
    (r"Physx\w*(Deformable|Cloth)\w*API", Reason("deformable bodies are not supported", loud=True)),
    (r"PhysxPhysics\w+JointAPI|Physx(Gear|RackAndPinion)\w*API", Reason("this joint is not supported", loud=True)),
    (r"PhysxCharacterControllerAPI", Reason("character controllers are not supported")),
    (
        r"Physx\w*(ForceSensor|ContactReport|JointResidual|ResidualReporting)API",
        Reason("a report of PhysX, not physics"),
    ),
    (r"PhysxMeshMergeCollisionAPI", Reason("each mesh below collides separately", loud=True)),
    (r"PhysxInstancerAPI|PhysxReplicatedAPI", Reason("a setting of PhysX's own scene")),
    (r"(Isaac|TensorPhysics|warp)\w*", Reason("a note of the simulator that wrote the file")),
    (r".*", Reason("this schema is not known here")),
)
# For schemas such as PhysicsMassAPI, the conversion report lists each omitted attribute, not the whole schema.
_BY_ATTRIBUTES = re.compile(
    r"Physics(Mass|MeshCollision|Material|FilteredPairs)API|Physics(Drive|Limit|JointState)API(:.*)?"
    r"|Physx(Joint|JointAxis|Limit|RigidBody|Collision|Articulation|Material|Scene|CookedData)API(:.*)?"
    r"|Physx(ConvexHull|ConvexDecomposition|TriangleMesh|TriangleMeshSimplification|SDFMesh|SphereFill)CollisionAPI"
    r"|Newton\w*API|Mjc\w*API"
)

_KINDS: tuple[tuple[str, Reason], ...] = (
    (r"Camera", Reason("cameras are not read")),
    (r"\w*Light(_1)?", Reason("lights are not read")),
    (r"PointInstancer", Reason("the copies of a PointInstancer are not read", loud=True)),
    (r"PhysicsCollisionGroup", Reason("it filters nothing of the robot")),
    (r"PhysicsScene", Reason("one scene is read")),
    (r"Physx(Particle|PBD|Deformable)\w*", Reason("particles and deformable bodies are not supported", loud=True)),
    (r"(Physx|Physics)\w*Joint", Reason("this kind of joint is not supported", loud=True)),
    (r"Physx\w+|Physics\w+", Reason("this kind of prim is not supported", loud=True)),
    (r"MjcKeyframe", Reason("this keyframe does not fit the model")),
    (r"(Mjc|Newton)\w+", Reason("this kind of prim is not supported", loud=True)),
    (r"Isaac\w+", Reason("a sensor of Isaac Sim that is not a frame on a body")),
    (r"OmniGraph\w*|ComputeGraph\w*|OmniSensor\w*", Reason("graphs and sensors of Omniverse run only in Isaac Sim")),
    (r"SkelRoot|Skeleton|SkelAnimation", Reason("skins are not read")),
)


@functools.cache
def why_schema(name: str) -> Reason | None:
    """Return why the MJCF omits a USD API schema; None if the conversion report needs no entry for the schema."""
    if not PHYSICAL_SCHEMAS.match(name) or _BY_ATTRIBUTES.fullmatch(name):
        return None
    base = name.split(":")[0]
    return next(reason for pattern, reason in _SCHEMAS if re.fullmatch(pattern, base))


@functools.cache
def why_kind(name: str) -> Reason | None:
    """Return why the conversion to MJCF drops a USD prim type; None for a prim type without physics."""
    return next((reason for pattern, reason in _KINDS if re.fullmatch(pattern, name)), None)


LONGEST = 200  # characters of a value


def audit(stage: Stage) -> None:
    """Record every authored physics property, applied schema, and prim that the converter has not read."""
    for prim in {p.GetPath(): p for p in (*stage.prims, *stage.physics_scenes, *_materials(stage))}.values():
        path, kind = prim.GetPath(), str(prim.GetTypeName())
        reasons = [(kind, f"a {kind}", why_kind(kind)), *((name, name, why_schema(name)) for name in schemas(prim))]
        for name, shown, reason in reasons:
            if reason and not stage.ledger.knows(path, name):
                if reason.loud:
                    stage.ledger.leave_and_warn(path, name, reason.text, shown)
                else:
                    stage.ledger.leave(path, name, reason.text)
        if prim.GetTypeName() == "Shader":
            for attribute in prim.GetAuthoredPropertyNames():
                value = prim.GetAttribute(attribute).Get() if attribute.startswith(("inputs:", "info:mdl")) else None
                if isinstance(value, Sdf.AssetPath) and value.path:
                    dropped = "colours are carried over, textures and material libraries are not"
                    missing = "" if value.resolvedPath else "; this file is missing"
                    stage.ledger.leave(prim.GetPath(), attribute, dropped + missing, value.path)
        group = prim.IsA(UsdPhysics.CollisionGroup)
        for name in prim.GetAuthoredPropertyNames():
            physical = PHYSICAL_PROPERTIES.match(name) or (group and name.startswith("collection:"))
            if physical and not stage.ledger.knows(prim.GetPath(), name):
                prop = prim.GetProperty(name)
                stage.ledger.leave(prim.GetPath(), name, _why(stage, prim, prop), _text(prop))
    _outside(stage)


def _materials(stage: Stage) -> Iterator[Usd.Prim]:
    for prim in stage.prims:
        for name in prim.GetAuthoredPropertyNames():
            if name.startswith("material:binding"):
                relationship = prim.GetRelationship(name)
                for path in relationship.GetForwardedTargets() if relationship else []:
                    material = stage.usd.GetPrimAtPath(path) if path.IsPrimPath() else None
                    if material and not material.IsPseudoRoot():
                        yield from Usd.PrimRange(material)


_MASS = ("physics:mass", "physics:density", "physics:centerOfMass", "physics:diagonalInertia", "physics:principalAxes")


def _why(stage: Stage, prim: Usd.Prim, prop: Usd.Property) -> str:
    """Return why the MJCF omits a USD property, judged by the property's name and by its prim."""
    name, kind = prop.GetName(), str(prim.GetTypeName())
    if isinstance(prop, Usd.Attribute) and not prop.HasAuthoredValue():
        return "declared without a value"
    if name in _MASS:
        applied, value = schemas(prim), plain(prop.Get()) if isinstance(prop, Usd.Attribute) else None
        numbers = np.asarray(value if isinstance(value, (int, float, tuple)) else np.nan)
        signed = name in ("physics:centerOfMass", "physics:principalAxes")
        if not np.isfinite(numbers).all() or (numbers.max() <= 0 and not signed):
            return "it means not given: not positive, or not finite"
        if "PhysicsRigidBodyAPI" in applied:
            return "not needed: the body or its colliders have a mass or a density of their own"
        if "PhysicsCollisionAPI" in applied:
            return "not needed: the collider or its body has mass properties of its own"
        if "PhysicsMaterialAPI" in applied:
            return "not needed: the bound shapes have a mass, or nothing is bound to this material"
        return "mass properties count only on bodies, colliders, and materials"
    joint = prim.IsA(UsdPhysics.Joint)
    if joint and stage.ledger.left_out(prim.GetPath(), kind):
        return "its joint was left out"
    if joint and not stage.ledger.knows(prim.GetPath(), kind):
        return "its joint has no effect"
    if name == "newton:inertia":
        return "zeros, which mean not given" if "PhysicsRigidBodyAPI" in schemas(prim) else "it counts only on bodies"
    if name.startswith(("drive:", "limit:", "state:")) and ":physics:" in name:
        return "the joint leaves no such axis free" if joint else "only joints have drives, limits, and states"
    if joint and name.startswith(("physics:lower", "physics:upper", "physics:cone", "physics:axis")):
        return "this joint has no such limit or axis"
    return next((text for pattern, text in _PROPERTIES if re.match(pattern, name)), "not known here")


def _text(prop: Usd.Property) -> str:
    try:
        if isinstance(prop, Usd.Relationship):
            return ", ".join(str(path) for path in prop.GetTargets())[:LONGEST]
        if not isinstance(prop, Usd.Attribute):
            return "not readable"
        value = plain(prop.Get()) if prop.HasAuthoredValue() else ""
    except Tf.ErrorException:
        return "not readable"
    return " ".join(str(value).split())[:LONGEST]


def _outside(stage: Stage) -> None:
    top = stage.root.GetPath().GetPrefixes()[:1]
    if not top:
        return
    used: set[Sdf.Path] = set()
    for prim in stage.prims:
        if prim.IsInstance() or prim.HasAuthoredReferences():
            nodes = [prim.GetPrimIndex().rootNode]
            while nodes:
                node = nodes.pop()
                nodes += node.children
                used |= set(node.path.GetPrefixes()[:1])
    for prim in stage.usd.GetPseudoRoot().GetChildren():
        if prim.GetPath() in (*top, *used) or prim.IsA(UsdPhysics.Scene):
            continue
        found = Counter(_sort(inner) for inner in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))
        parts = [f"{sort}: {found[sort]}" for sort in ("bodies", "joints", "colliders") if found[sort]]
        if parts:
            reason = f"it is outside the default prim {stage.root.GetPath()}"
            stage.ledger.leave(prim.GetPath(), str(prim.GetTypeName()) or "prim", reason, ", ".join(parts))


def _sort(prim: Usd.Prim) -> str:
    if prim.IsA(UsdPhysics.Joint):
        return "joints"
    applied = [name for name in schemas(prim) if PHYSICAL_SCHEMAS.match(name)]
    return "bodies" if "PhysicsRigidBodyAPI" in applied else "colliders" if "PhysicsCollisionAPI" in applied else ""
