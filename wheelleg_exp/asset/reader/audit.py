"""Goes through every authored property that carries physics, and names those that nobody read."""

from __future__ import annotations

from pxr import Usd, UsdPhysics

from wheelleg_exp.asset.reader.ledger import plain
from wheelleg_exp.asset.reader.stage import Stage

PHYSICAL = (
    "physics:",
    "physx",
    "drive:",
    "limit:",
    "state:",
    "newton:",
    "mjc:",
    "urdf:",
    "isaac:physics",
    "omni:physx",
)

REASONS = (  # (beginning of the name, why it has no place); the first that fits
    ("physxArticulation:solver", "solver iterations of PhysX; MuJoCo's solver has its own"),
    ("physxScene:", "a setting of PhysX's own solver"),
    ("physxArticulation:", "a setting of PhysX's articulations"),
    ("physxRigidBody:", "a setting of PhysX's bodies: solver, sleep, damping or velocity limits"),
    ("physxCollision:", "contact and rest offsets of PhysX"),
    ("physxConvexHull", "PhysX's mesh cooking"),
    ("physxConvexDecomposition", "PhysX's mesh cooking"),
    ("physxTriangleMesh", "PhysX's mesh cooking"),
    ("physxSDF", "PhysX's mesh cooking"),
    ("physxLimit:", "soft limits of PhysX"),
    ("physxJoint:jointFriction", "a coefficient of joint force, not a friction torque"),
    ("physxMaterial:", "PhysX's own contact model"),
    ("physics:breakForce", "joints never break in MuJoCo"),
    ("physics:breakTorque", "joints never break in MuJoCo"),
    ("physics:JointEquivalentInertia", "a note of the importer, no physics"),
    ("physics:startsAsleep", "MuJoCo's bodies start awake"),
    ("physics:velocity", "an initial velocity; initial states come from the task"),
    ("physics:angularVelocity", "an initial velocity; initial states come from the task"),
    ("physics:principalAxes", "axes without principal moments say nothing"),
    ("physics:simulationOwner", "there is one simulation"),
    ("isaac:physics", "Isaac's own index of links and joints; they are read from the prims"),
    ("physics:staticFriction", "no collider is bound to this material"),
    ("physics:dynamicFriction", "no collider is bound to this material"),
    ("physics:restitution", "no collider is bound to this material"),
    ("physics:density", "not needed: what it would weigh has a mass, or nothing is bound to it"),
    ("physics:mass", "a mass of 0 means not given; a collider's mass does not count beside its body's"),
    ("physics:centerOfMass", "not finite, which means not given; or a collider's, which is not read"),
    ("physics:diagonalInertia", "zero, which means not given; or a collider's, which is not read"),
    ("physics:gravity", "zero or negative, which means not given"),
    ("newton:", "a setting of Newton's solvers"),
    ("mjc:", "this MuJoCo attribute is not supported yet"),
    ("physics:", "not supported here"),
)

KINDS = {  # prim types that people may miss
    "Camera": "cameras are not read",
    "PointInstancer": "point instances are not read",
    "PhysicsDistanceJoint": "this kind of joint is not supported",
}


def audit(stage: Stage) -> None:
    """Name every authored physics property that nothing read, and every prim that has no place."""
    known = {str(prim.GetPath()) for prim in stage.prims}
    scenes = [prim for prim in stage.usd.Traverse() if prim.IsA(UsdPhysics.Scene)]
    for prim in [*stage.prims, *(scene for scene in scenes if str(scene.GetPath()) not in known)]:
        _kinds(stage, prim)
        for prop in prim.GetAuthoredProperties():
            name = prop.GetName()
            if name.startswith(PHYSICAL) and not stage.ledger.knows(prim.GetPath(), name):
                stage.ledger.leave(prim.GetPath(), name, reason_for(name), _text(prop))


def _kinds(stage: Stage, prim: Usd.Prim) -> None:
    kind, path = str(prim.GetTypeName()), prim.GetPath()
    reason = KINDS.get(kind)
    if kind.endswith("Light"):
        reason = "lights are not read"
    elif kind.startswith(("Mjc", "PhysxTendon")) and kind != "MjcActuator":
        reason = "not supported yet"
        stage.ledger.warn(f"{path}: a {kind} is not supported and was left out")
    if reason and not stage.ledger.knows(path, kind):
        stage.ledger.leave(path, kind, reason)


def reason_for(name: str) -> str:
    """Return why a property has no place in the model."""
    return next((reason for start, reason in REASONS if name.startswith(start)), "not supported")


def _text(prop: Usd.Property) -> str:
    if isinstance(prop, Usd.Relationship):
        return ", ".join(str(path) for path in prop.GetTargets())
    value = plain(prop, str(prop.GetPrim().GetPath())) if prop.HasAuthoredValue() else None
    return str(value)[:200]
