"""Why something that carries physics has no place in the model: properties, applied schemas and kinds of prims.

Each table is a list of patterns of full names; the first that fits says why. What no pattern fits is named as well,
as not known here.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

PHYSICAL_PROPERTIES = re.compile(
    r"physics:|physx|drive:|limit:|state:|newton:|mjc:|mjcf:|urdf:|isaac:physics|omni:physx|warpSim:"
    r"|material:binding:(physics|collection:physics)"
)
PHYSICAL_SCHEMAS = re.compile(r"(TensorPhysics|Physics|Physx|Newton|Mjc|Isaac\w*(Joint|Link|Robot)|warp)\w*API")


@dataclass(frozen=True)
class Reason:
    """Why something is left out; ``loud`` when the robot will move otherwise without it."""

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
    (r"physics:JointEquivalentInertia", "a note of the importer, no physics"),
    (r"physics:startsAsleep", "MuJoCo's bodies start awake"),
    (r"physics:(velocity|angularVelocity|linearVelocity)", "only a floating body's velocity is a state of the model"),
    (r"physics:simulationOwner", "there is one simulation"),
    (r"physics:(engine|tensor:|newton:)", "a note of the simulator that wrote the file"),
    (r"physics:(static|dynamic)Friction|physics:restitution", "no collider is bound to this material"),
    (r"physics:gravity", "zero or negative, which means not given"),
    (r"physics:approximation", "only meshes are approximated"),
    (r"state:\w+:physics:appliedForce", "what a joint was pushed by when the file was saved"),
    (r"isaac:physics", "Isaac's own index of links and joints; they are read from the prims"),
    (r"material:binding:", "no collider of the robot takes its friction from this binding"),
    (r"urdf:", "a note of the converter that wrote the file"),
    (r"newton:", "a setting of Newton's solvers"),
    (r"mjcf:", "a note of the importer, no physics"),
    (r"mjc:", "this MuJoCo attribute is not supported yet"),
    (r"physx|omni:physx|warpSim:", "a setting of another simulator"),
)

_SCHEMAS: tuple[tuple[str, Reason], ...] = (
    (r"PhysicsCollisionAPI", Reason("no shape at it or below it collides", loud=True)),
    (r"PhysicsRigidBodyAPI", Reason("it is switched off, or no body of the robot")),
    (r"PhysicsArticulationRootAPI", Reason("it stands on nothing that is joined")),
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
        Reason("a report of PhysX, no physics"),
    ),
    (r"PhysxMeshMergeCollisionAPI", Reason("each mesh below collides by itself, unmerged", loud=True)),
    (r"PhysxInstancerAPI|PhysxReplicatedAPI", Reason("a setting of PhysX's own scene")),
    (r"(Isaac|TensorPhysics|warp)\w*", Reason("a note of the simulator that wrote the file")),
    (r".*", Reason("this schema is not known here")),
)
# What these say stands in attributes that are accounted for one by one.
_BY_ATTRIBUTES = re.compile(
    r"Physics(Mass|MeshCollision|Material|FilteredPairs)API|Physics(Drive|Limit|JointState)API(:.*)?"
    r"|Physx(Joint|JointAxis|Limit|RigidBody|Collision|Articulation|Material|Scene|CookedData)API(:.*)?"
    r"|Physx(ConvexHull|ConvexDecomposition|TriangleMesh|TriangleMeshSimplification|SDFMesh|SphereFill)CollisionAPI"
    r"|Newton\w*API|Mjc\w*API"
)

_KINDS: tuple[tuple[str, Reason], ...] = (
    (r"Camera", Reason("cameras are not read")),
    (r"\w*Light(_1)?", Reason("lights are not read")),
    (r"PointInstancer", Reason("it has no shapes")),
    (r"PhysicsCollisionGroup", Reason("it filters nothing of the robot")),
    (r"PhysicsScene", Reason("one scene is read")),
    (r"Physx(Particle|PBD|Deformable)\w*", Reason("particles and deformable bodies are not supported", loud=True)),
    (r"(Physx|Physics)\w*Joint", Reason("this kind of joint is not supported", loud=True)),
    (r"Physx\w+|Physics\w+", Reason("this kind of prim is not supported", loud=True)),
    (r"MjcKeyframe", Reason("this keyframe does not fit the model")),
    (r"(Mjc|Newton)\w+", Reason("this kind of prim is not supported", loud=True)),
    (r"Isaac\w+", Reason("a sensor of Isaac Sim that is no frame on a body")),
    (r"OmniGraph\w*|ComputeGraph\w*|OmniSensor\w*", Reason("graphs and sensors of Omniverse run in Isaac Sim alone")),
    (r"SkelRoot|Skeleton|SkelAnimation", Reason("skins are not read")),
)


def why_property(name: str) -> str:
    """Return why a property has no place in the model."""
    return next((text for pattern, text in _PROPERTIES if re.match(pattern, name)), "not known here")


@functools.cache
def why_schema(name: str) -> Reason | None:
    """Return why an applied schema has no place, None when it is no physics or its attributes say it all."""
    if not PHYSICAL_SCHEMAS.match(name) or _BY_ATTRIBUTES.fullmatch(name):
        return None
    base = name.split(":")[0]
    return next(reason for pattern, reason in _SCHEMAS if re.fullmatch(pattern, base))


@functools.cache
def why_kind(name: str) -> Reason | None:
    """Return why a kind of prim has no place, None when it carries no physics."""
    return next((reason for pattern, reason in _KINDS if re.fullmatch(pattern, name)), None)
