"""Complete a robot description with the data of MuJoCo's USD schemas, which override Newton's, and these PhysX's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeVar

from pxr import Usd, UsdShade

from wheelleg_exp.asset import robot_description as desc
from wheelleg_exp.asset.usd import mjc_parts as mjc
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Links
from wheelleg_exp.asset.usd.usd_stage import Stage, angle_in_radians, find_scene, schemas

_OF_JOINTS = "springdamper margin solreflimit solimplimit solreffriction solimpfriction actuatorgravcomp group"
JOINT_ATTRIBUTES = {f"mjc:{name}": name for name in _OF_JOINTS.split()}


def _dof(stage: Stage, dof: desc.Dof) -> desc.Dof:
    prim = stage.usd.GetPrimAtPath(dof.path)
    found = mjc.attributes(stage, prim, JOINT_ATTRIBUTES)
    springref = stage.ledger.read(prim, "mjc:springref", "springref")
    if springref is not None:
        found["springref"] = angle_in_radians(stage, springref) if dof.kind == "hinge" else float(springref)
    if stage.ledger.read(prim, "mjc:actuatorfrclimited", "actuatorfrclimited") == "false" and dof.force_range:
        found["actuatorfrclimited"] = False
    return replace(dof, extra={**dof.extra, **found}) if found else dof


HULLS = {"newton:maxHullVertices": "maxhullvert", "mjc:maxhullvert": "maxhullvert"}
NEWTON = {"newton:contactMargin": "margin", "newton:contactGap": "gap"}
_OF_GEOMS = "condim priority solref solimp solmix margin gap"
GEOM_ATTRIBUTES = {f"mjc:{name}": name for name in _OF_GEOMS.split()}
FRICTION = (0.0, 0.005, 0.0001)
DRAWN = {"MjcCollisionAPI", "MjcImageableAPI"}
SOLID = {"MjcCollisionAPI", "NewtonCollisionAPI"}


def with_geom_extra(stage: Stage, geom: desc.Geom) -> desc.Geom:
    """Return a geom with MuJoCo's own attributes: those of its prim, or of an ancestor that has them."""
    prim = stage.usd.GetPrimAtPath(geom.path)
    found: dict[str, mjc.Attribute] = {}
    drawn = _carrier(prim, DRAWN)
    if drawn:
        found["group"] = int(stage.ledger.read(drawn, "mjc:group", "group") or 0)
    solid = _carrier(prim, SOLID) if geom.collides else None
    if solid:
        found |= mjc.attributes(stage, solid, NEWTON) | mjc.attributes(stage, solid, GEOM_ATTRIBUTES)
        found |= _friction(stage, prim, geom)
    return replace(geom, extra={**geom.extra, **found}) if found else geom


def _carrier(prim: Usd.Prim, wanted: set[str]) -> Usd.Prim | None:
    while prim and not prim.IsPseudoRoot():
        found = set(schemas(prim))
        if wanted & found:
            return prim
        if "PhysicsRigidBodyAPI" in found:
            return None
        prim = prim.GetParent()
    return None


def _friction(stage: Stage, prim: Usd.Prim, geom: desc.Geom) -> dict[str, mjc.Attribute]:
    bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
    if not bound or geom.friction is None:
        return {}
    material = bound.GetPrim()
    values = [geom.friction, *FRICTION[1:]]
    for schema, suffix in (("newton:", "Friction"), ("mjc:", "friction")):
        for index, kind in enumerate(("torsional", "rolling"), start=1):
            value = stage.ledger.read(material, f"{schema}{kind}{suffix}", f"geom friction[{index}]")
            if value is not None and value >= 0:
                values[index] = float(value)
    return {} if tuple(values[1:]) == FRICTION[1:] else {"friction": tuple(values)}


LINEAR = (0.0, 1.0, 0.0, 0.0, 0.0)
SOLVER = {"mjc:solref": "solref", "mjc:solimp": "solimp"}
COEFFICIENTS = (*(f"newton:mimicCoef{i}" for i in (0, 1)), *(f"mjc:coef{i}" for i in range(5)))
COUPLED = {"NewtonMimicAPI", "MjcEqualityJointAPI"}
CLOSED = {"MjcEqualityAPI", "MjcEqualityConnectAPI", "MjcEqualityWeldAPI"}


def with_closure_extra(stage: Stage, closure: desc.Closure) -> desc.Closure:
    """Add the solver attributes and the flag ``active`` of MuJoCo's USD schemas to a loop closure."""
    prim = stage.usd.GetPrimAtPath(closure.path)
    if not CLOSED & set(schemas(prim)):
        return closure
    found = mjc.attributes(stage, prim, SOLVER | ({"mjc:torqueScale": "torquescale"} if closure.kind == "weld" else {}))
    if stage.ledger.read(prim, "physics:jointEnabled", "active") is False:
        found["active"] = False
    return replace(closure, extra={**closure.extra, **found})


def read_couplings(stage: Stage, dofs: Mapping[str, desc.Dof]) -> tuple[desc.Coupling, ...]:
    """Read joint couplings from NewtonMimicAPI and MjcEqualityJointAPI; ``dofs`` maps prim paths to MuJoCo joints."""
    found = []
    for prim in stage.prims:
        dof = dofs.get(str(prim.GetPath()))
        if dof is None or not COUPLED & set(schemas(prim)):
            continue
        leaders = stage.ledger.targets(prim, "newton:mimicJoint", "equality joint")
        leaders += stage.ledger.targets(prim, "mjc:target", "equality joint")
        leader = dofs.get(str(leaders[0])) if leaders else None
        if leader is None:
            stage.ledger.warn(f"{prim.GetPath()}: follows no joint of the robot, so the coupling was left out")
            continue
        extra: dict[str, mjc.Attribute] = mjc.attributes(stage, prim, SOLVER)
        if stage.ledger.read(prim, "newton:mimicEnabled", "active") is False:
            extra["active"] = False
        # The offset newton:mimicCoef0 is in the joint's USD unit, but mjc:coef0 is in SI units.
        values = list(LINEAR)
        for name in COEFFICIENTS:
            value = stage.ledger.read(prim, name, "equality joint polycoef")
            if value is not None:
                in_si = stage.units.coordinate(value, dof.kind == "hinge") if name == "newton:mimicCoef0" else value
                values[int(name[-1])] = float(in_si)
        a, b, c, d, e = values
        name = f"{dof.name}_coupling"
        found.append(desc.Coupling(name, dof.path, dof.name, leader.name, (a, b, c, d, e), extra))
    return tuple(found)


INTEGRATORS = {"euler": "Euler", "rk4": "RK4", "implicit": "implicit", "implicitfast": "implicitfast"}
# The robot's MJCF file gets only options in ``_OPTIONS``; a task's config sets the physics time step and the solver.
_OPTIONS = """cone impratio density viscosity wind magnetic o_margin o_solref o_solimp o_friction
noslip_iterations noslip_tolerance"""
OPTIONS = {f"mjc:option:{name}": name for name in _OPTIONS.split()}
GROUPS = 31
FLAGS = """constraint equality frictionloss limit contact spring damper gravity clampctrl warmstart filterparent
actuation refsafe sensor midphase eulerdamp autoreset nativeccd island override energy fwdinv invdiscrete
multiccd sleep"""
SOLVER_REASON = "a setting of the solver or time step, which the task defines, not the robot"
SOLVER_OPTIONS = """apirate timestep iterations ls_iterations tolerance ls_tolerance ccd_iterations ccd_tolerance
sdf_iterations sdf_initpoints sleep_tolerance jacobian solver"""
COMPILER = {  # reasons for omitting settings
    "angle": "angles are written in radians",
    "autoLimits": "ranges are written with their effective limits",
    "saveInertial": "a setting for saving models",
    "useThread": "a setting of the compiler's speed",
    "fitAABB": "shapes are written unchanged",
    "inertiaFromGeom": "masses and inertias are written explicitly",
    "inertiaGroupRange:min": "masses and inertias are written explicitly",
    "inertiaGroupRange:max": "masses and inertias are written explicitly",
    "balanceInertia": "impossible inertias are always corrected",
    "fuseStatic": "bodies stay as in the file",
    "alignFree": "a setting of the compiler's speed",
}


def with_options(stage: Stage, robot: desc.RobotDescription) -> desc.RobotDescription:
    """Return the robot description with the MuJoCo options and flags that the USD physics scene sets."""
    scene = find_scene(stage)
    if scene is None:
        return robot
    for name in SOLVER_OPTIONS.split():
        mjc.leave(stage, scene, f"mjc:option:{name}", SOLVER_REASON)
    for name, reason in COMPILER.items():
        mjc.leave(stage, scene, f"mjc:compiler:{name}", reason)
    robot = with_compiled_masses(stage, scene, robot)
    switches = mjc.attributes(stage, scene, {f"mjc:flag:{name}": name for name in FLAGS.split()})
    passive = stage.ledger.read(scene, "mjc:flag:passive", "flags spring and damper")  # of older files
    if passive is not None:
        switches = {"spring": passive, "damper": passive, **switches}
    flags = {**robot.flag, **{name: "enable" if on else "disable" for name, on in switches.items()}}
    found: dict[str, mjc.Attribute] = {}
    name = "mjc:option:integrator"
    integrator = stage.ledger.read(scene, name, "option integrator")
    if integrator in INTEGRATORS:
        found["integrator"] = INTEGRATORS[integrator]
    elif integrator is not None:
        stage.ledger.leave(scene.GetPath(), name, "not an integrator of MuJoCo", integrator)
    found |= mjc.attributes(stage, scene, OPTIONS)
    off = [g for g in mjc.indices(stage, scene, "mjc:option:actuatorgroupdisable", "option") if 0 <= g < GROUPS]
    if off:
        found["actuatorgroupdisable"] = " ".join(map(str, off))
    return replace(robot, option={**robot.option, **found}, flag=flags)


COMPILED_MASSES = ("boundMass", "boundInertia", "setTotalMass")


def with_compiled_masses(stage: Stage, scene: Usd.Prim, robot: desc.RobotDescription) -> desc.RobotDescription:
    """Apply the compiler settings ``boundMass``, ``boundInertia``, and ``setTotalMass`` to the robot's masses."""
    became = "masses and inertias of the bodies"
    values = {name: stage.ledger.read(scene, f"mjc:compiler:{name}", became) for name in COMPILED_MASSES}
    if not any(values.values()):
        return robot
    least, smallest, wanted = (values[name] or 0.0 for name in COMPILED_MASSES)
    masses = [max(body.inertial.mass, least) for body in robot.bodies]
    factor = wanted / sum(masses) if wanted > 0 and sum(masses) > 0 else None
    if factor is not None:
        stage.ledger.assume(scene.GetPath(), "mjc:compiler:setTotalMass scales all masses", f"{factor:.6g}")
    bodies = []
    for body, mass in zip(robot.bodies, masses, strict=True):
        a, b, c = (max(moment, smallest) * (factor or 1.0) for moment in body.inertial.moments)
        inertial = replace(body.inertial, mass=mass * (factor or 1.0), moments=(a, b, c))
        bodies.append(replace(body, inertial=inertial))
    return replace(robot, bodies=tuple(bodies))


def with_mujoco(stage: Stage, links: Links, robot: desc.RobotDescription) -> desc.RobotDescription:
    """Return the robot description completed with all data of MuJoCo's USD schemas."""
    robot = mjc.with_wraps(stage, links, robot)
    hulls = dict[str, dict[str, int]]()
    for geom in robot.geoms:
        if geom.mesh:  # the most vertices of a mesh's convex hull
            found = mjc.attributes(stage, stage.usd.GetPrimAtPath(geom.path), HULLS)
            if sizes := {key: value for key, value in found.items() if isinstance(value, int) and value > 0}:
                hulls[geom.mesh] = sizes
    bodies = []
    for body in robot.bodies:
        found = mjc.attributes(stage, stage.usd.GetPrimAtPath(body.path), {"mjc:body:gravcomp": "gravcomp"})
        dofs, geoms = [_dof(stage, dof) for dof in body.dofs], [with_geom_extra(stage, geom) for geom in body.geoms]
        bodies.append(replace(body, dofs=tuple(dofs), geoms=tuple(geoms), extra={**body.extra, **found}))
    robot = replace(
        robot,
        bodies=tuple(bodies),
        static_geoms=tuple(with_geom_extra(stage, geom) for geom in robot.static_geoms),
        closures=tuple(with_closure_extra(stage, closure) for closure in robot.closures),
        meshes=tuple(replace(m, extra={**m.extra, **hulls[m.name]}) if m.name in hulls else m for m in robot.meshes),
    )
    count = Counter(dof.path for dof in robot.dofs)
    single = {dof.path: dof for dof in robot.dofs if count[dof.path] == 1}
    names = {path: dof.name for path, dof in single.items()}
    sites = {site.path: site.name for site in robot.sites}
    shapes = {geom.path: geom.name for geom in robot.geoms}
    tendons = distinct(robot.tendons, mjc.read_tendons(stage, names, sites, shapes))
    ranged = {dof.name for dof in robot.dofs if dof.range} | {t.name for t in (*robot.tendons, *tendons) if t.range}
    elements: dict[str, tuple[mjc.Transmission, str]] = {body.path: ("body", body.name) for body in robot.bodies}
    elements |= {path: ("site", name) for path, name in sites.items()}
    elements |= {tendon.path: ("tendon", tendon.name) for tendon in tendons}
    elements |= {path: ("joint", name) for path, name in names.items()}
    couplings = distinct(robot.couplings, read_couplings(stage, single))
    robot = replace(
        robot,
        tendons=(*robot.tendons, *tendons),
        couplings=(*robot.couplings, *couplings),
        actuators=(*robot.actuators, *mjc.read_actuators(stage, elements, ranged)),
    )
    # If a USD joint has a MuJoCo actuator and a USD drive, the MuJoCo actuator has priority.
    driven = {item.target for item in robot.actuators if item.transmission in ("joint", "jointinparent")}
    bodies = []
    for body in robot.bodies:
        free = tuple(replace(d, drive=None) if d.drive and d.name in driven else d for d in body.dofs)
        for dof in (old for old, new in zip(body.dofs, free, strict=True) if old is not new):
            for prop in stage.usd.GetPrimAtPath(dof.path).GetAuthoredPropertiesInNamespace("drive"):
                stage.ledger.leave(dof.path, prop.GetName(), "a MjcActuator acts on this joint and wins over its drive")
        bodies.append(replace(body, dofs=free) if free != body.dofs else body)
    robot = replace(robot, bodies=tuple(bodies))
    robot = replace(robot, actuators=distinct([dof for dof in robot.dofs if dof.drive], robot.actuators))
    robot = with_options(stage, robot)
    return replace(robot, keyframes=(*robot.keyframes, *mjc.read_keyframes(stage, robot)))


Part = TypeVar("Part", desc.Site, desc.Tendon, desc.Coupling, desc.Actuator)


def distinct(known: Iterable[desc.Dof | Part], parts: Iterable[Part]) -> tuple[Part, ...]:
    """Return ``parts`` with unique names: a name that ``known`` already contains gets a number as suffix."""
    names = desc.Numbered(item.name for item in known)
    return tuple(replace(part, name=names.take(part.name)) for part in parts)
