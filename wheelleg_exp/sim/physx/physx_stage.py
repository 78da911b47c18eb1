"""The USD scene that PhysX simulates: the ground and N robots, which refer to the robot's own USD file."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rendering.scene_models import mesh
from wheelleg_exp.sim.terrain import TERRAIN_KEY, is_ground

GROUND_PATH, ROBOTS = "/World/ground", "/World/robots"
_ASSET = "env.robot.asset"
_FAMILIES = ("PhysxSchema", "OmniUsdPhysicsDeformableSchema")
# The filter of a collision group lists the groups that it collides with, so that the robots of two environments never
# touch. PhysX combines two materials by the stronger of their modes (average, min, multiply, max). With 0 and max, the
# friction is the robot's coefficient, which MuJoCo's model already combines with the ground's coefficient.
_SCENE = """#usda 1.0
(
    defaultPrim = "World"
    upAxis = "Z"
    metersPerUnit = 1
    kilogramsPerUnit = 1
)
def Xform "World"
{{
    def PhysicsScene "scene" (prepend apiSchemas = ["PhysxSceneAPI"])
    {{
        vector3f physics:gravityDirection = ({down})
        float physics:gravityMagnitude = {gravity}
        bool physxScene:invertCollisionGroupFilter = 1
        bool physxScene:enableGPUDynamics = 0
        uniform token physxScene:broadphaseType = "MBP"
    }}
    def Material "material" (prepend apiSchemas = ["PhysicsMaterialAPI", "PhysxMaterialAPI"])
    {{
        float physics:staticFriction = 0
        float physics:dynamicFriction = 0
        float physics:restitution = 0
        uniform token physxMaterial:frictionCombineMode = "max"
        uniform token physxMaterial:restitutionCombineMode = "max"
    }}
    def Xform "ground" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        rel material:binding:physics = </World/material>
{ground}
    }}
    def PhysicsCollisionGroup "group_of_ground" (prepend apiSchemas = ["CollectionAPI:colliders"])
    {{
        rel collection:colliders:includes = </World/ground>
        rel physics:filteredGroups = [{groups}]
    }}
    def Xform "robots"
    {{
{robots}
    }}
}}
"""
_ROBOT = """def Xform "{name}" (references = @@@{usd}@@@)
{{
{overs}
}}
def PhysicsCollisionGroup "group_of_{name}" (prepend apiSchemas = ["CollectionAPI:colliders"])
{{
    rel collection:colliders:includes = </World/robots/{name}>
    rel physics:filteredGroups = [</World/robots/group_of_{name}>, </World/group_of_ground>]
}}"""
_was_registered = False


def links_of(usd: Path) -> tuple[str, dict[str, str]]:
    """Return the path of a robot's articulation root, and the paths of its bodies by name, from its default prim."""
    from pxr import Usd, UsdGeom, UsdPhysics

    if not Usd.Stage.IsSupportedFile(str(usd)):
        message = f"PhysX simulates a robot's USD file, and '{usd.name}' is not one"
        raise ConfigError(message, key=_ASSET, expected="a USD file, or env.sim.engine=mujoco")
    stage = Usd.Stage.Open(str(usd))
    top = stage.GetDefaultPrim()
    prims = {str(prim.GetPath().MakeRelativePath(top.GetPath())): prim for prim in Usd.PrimRange(top)}
    units = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    up = UsdGeom.GetStageUpAxis(stage)
    if (*units, up) != (1.0, 1.0, "Z"):
        message = f"{usd.name} has metersPerUnit and kilogramsPerUnit {units} and upAxis {up}"
        raise ConfigError(message, key=_ASSET, expected="1, 1, and Z, for the engine 'physx'")
    if any(prim.IsA(UsdPhysics.CollisionGroup) for prim in prims.values()):
        message = f"{usd.name} has collision groups, which the engine 'physx' needs for the environments"
        raise ConfigError(message, key=_ASSET, expected="filtered pairs, or env.sim.engine=mujoco")
    roots = [path for path, prim in prims.items() if prim.HasAPI(UsdPhysics.ArticulationRootAPI)]
    bodies = {prim.GetName(): path for path, prim in prims.items() if prim.HasAPI(UsdPhysics.RigidBodyAPI)}
    if len(roots) != 1 or roots[0] == ".":
        message = f"{usd.name} has its articulation roots at: {', '.join(roots) or '(nowhere)'}"
        raise ConfigError(message, key=_ASSET, expected="one root below the default prim, for the engine 'physx'")
    if prims[roots[0]].IsA(UsdPhysics.Joint):
        message = f"{usd.name} has its articulation root at the joint {roots[0]}"
        raise ConfigError(message, key=_ASSET, expected="a root that is not a joint, for the engine 'physx'")
    return roots[0], bodies


def write_scene(
    path: Path,
    usd: Path,
    root: str,
    links: Mapping[str, str],
    model: mujoco.MjModel,
    num_envs: int,
    self_collisions: bool | None,
) -> None:
    """Write the USD layer of N robots, named ``env_0`` and so on, and of the ground of a MuJoCo model.

    The names have leading zeros, because PhysX sorts prims by name. ``self_collisions`` overrides the USD file's.
    """
    overs = _overs(links.values(), root, self_collisions, *_changes(usd))
    names = [f"env_{i:0{len(str(num_envs - 1))}d}" for i in range(num_envs)]
    ground = [_ground_prim(model, geom) for geom in range(model.ngeom) if is_ground(model.geom(geom).name)]
    size = float(np.linalg.norm(model.opt.gravity))
    text = _SCENE.format(
        down=_numbers(model.opt.gravity / size if size else [0.0, 0.0, -1.0]),
        gravity=size,
        ground="\n".join(ground),
        groups=", ".join(["</World/group_of_ground>", *(f"<{ROBOTS}/group_of_{name}>" for name in names)]),
        robots="\n".join(_ROBOT.format(name=name, usd=usd.as_posix(), overs=overs) for name in names),
    )
    path.write_text(text, encoding="utf-8")


def _changes(usd: Path) -> tuple[dict[str, set[str]], dict[str, str]]:
    """Return the API schemas and the other metadata (USD text) that the scene adds to prims of a robot's USD file.

    Instances become ordinary prims, because PhysX ignores a collider in an instance that is a group of meshes. Shapes
    below a collider become colliders, because PhysX ignores a collider without a shape of its own; a collider that has
    the approximation of a mesh is one collider in PhysX as well. Joints get drives, without which PhysX ignores the
    gains that it is sent, and joints to the world are removed, because only floating robots are simulated.
    """
    from pxr import Usd, UsdGeom, UsdPhysics

    def below(prim: Usd.Prim) -> Iterator[Usd.Prim]:
        return iter(Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))

    def path_of(prim: Usd.Prim) -> str:
        return str(prim.GetPath().MakeRelativePath(top.GetPath()))

    def is_to_world(joint: UsdPhysics.Joint) -> bool:
        ends = [end.GetTargets() for end in (joint.GetBody0Rel(), joint.GetBody1Rel())]
        above = [[stage.GetPrimAtPath(path) for path in end[0].GetPrefixes()] if end else [] for end in ends]
        return not all(any(prim and prim.HasAPI(UsdPhysics.RigidBodyAPI) for prim in prims) for prims in above)

    stage = Usd.Stage.Open(str(usd))
    top = stage.GetDefaultPrim()
    apis: defaultdict[str, set[str]] = defaultdict(set)
    facts: dict[str, str] = {}
    for prim in below(top):
        if prim.IsInstance():
            facts[path_of(prim)] = "instanceable = false"
        elif prim.IsA(UsdPhysics.Joint) and is_to_world(UsdPhysics.Joint(prim)):
            facts[path_of(prim)] = "active = false"
        elif prim.IsA(UsdPhysics.RevoluteJoint) or prim.IsA(UsdPhysics.PrismaticJoint):
            apis[path_of(prim)].add(f"PhysicsDriveAPI:{'angular' if prim.IsA(UsdPhysics.RevoluteJoint) else 'linear'}")
        is_group = prim.HasAPI(UsdPhysics.CollisionAPI) and not prim.HasAPI(UsdPhysics.MeshCollisionAPI)
        if is_group and not prim.IsA(UsdGeom.Gprim):
            for shape in below(prim):
                if shape.IsA(UsdGeom.Gprim):
                    apis[path_of(shape)].add("PhysicsCollisionAPI")
    return dict(apis), facts


def _overs(
    links: Collection[str],
    root: str,
    self_collisions: bool | None,
    changed_apis: Mapping[str, Collection[str]],
    changed_facts: Mapping[str, str],
) -> str:
    """Return USD text that makes all links report their contacts, sets self-collisions at the root, and has changes."""
    children: dict[str, list[str]] = {}
    for path in (*links, *sorted({*changed_apis, *changed_facts})):
        children.setdefault(path, [])
        for parent in (str(p) for p in Path(path).parents):
            if path not in children.setdefault(parent, []):
                children[parent].append(path)
            path = parent

    def text(path: str) -> str:
        apis, values = sorted(changed_apis.get(path, ())), []
        if path in links:
            apis, values = [*apis, "PhysxContactReportAPI"], ["float physxContactReport:threshold = 0"]
        if path == root and self_collisions is not None:
            apis.append("PhysxArticulationAPI")
            values.append(f"bool physxArticulation:enabledSelfCollisions = {int(self_collisions)}")
        facts = [f"prepend apiSchemas = {json.dumps(apis)}"] if apis else []
        facts += [changed_facts[path]] if path in changed_facts else []
        listed = f"({'; '.join(facts)})" if facts else ""
        inner = "\n".join([*values, *(text(child) for child in children[path])])
        return f'over "{Path(path).name}" {listed}\n{{\n{inner}\n}}'

    return "\n".join(text(child) for child in children["."])


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.9g}" for value in values)


def _ground_prim(model: mujoco.MjModel, geom: int) -> str:
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    apis = '(prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"])'
    pose = f"""quatd xformOp:orient = ({_numbers(model.geom_quat[geom])})
        double3 xformOp:translate = ({_numbers(model.geom_pos[geom])})
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]"""
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return f'def Plane "geom_{geom}" {apis}\n{{\n        uniform token axis = "Z"\n        {pose}\n}}'
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        points, triangles = signs * size, np.array([[f[0], f[i], f[i + 1]] for f in faces for i in (1, 2)])
    elif kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        points, pairs, _ = mesh(model, geom)
        triangles = pairs.reshape(-1, 2, 3).swapaxes(0, 1).reshape(-1, 3)  # first one of each cell, then the other
    else:
        message = f"the ground has a geom of the type {kind.name.removeprefix('mjGEOM_').lower()}"
        raise ConfigError(message, key=TERRAIN_KEY, expected="planes, boxes and height fields, or engine: mujoco")
    return f"""def Mesh "geom_{geom}" {apis}
{{
        int[] faceVertexCounts = [{", ".join("3" for _ in triangles)}]
        int[] faceVertexIndices = [{", ".join(map(str, triangles.ravel()))}]
        point3f[] points = [{", ".join(f"({_numbers(point)})" for point in points)}]
        uniform token physics:approximation = "none"
        uniform token subdivisionScheme = "none"
        {pose}
}}"""


def open_scene(path: Path, threads: int) -> tuple[Any, Any]:
    """Return PhysX with the scene of a USD file, and the scene's stage, which must live as long as PhysX."""
    import ovphysx
    import ovstage
    from ovphysx.types import GlobalConfigKey

    global _was_registered  # USD schemas can only be registered once in a process.
    if not _was_registered:
        schemas = metadata.distribution("physx-usd-schemas")
        roots = [str(schemas.locate_file(f"physx_usd_schemas/{family}/resources")) for family in _FAMILIES]
        ovstage.population.register_usd_schemas([*roots, str(ovphysx.newton_schema_root())])
        ovphysx.enable_default_log_output(False)  # PhysX writes to standard output, where commands print JSON.
        ovphysx.PhysX.set_cpu_mode(True)
        ovphysx.set_global_config(GlobalConfigKey.NUM_THREADS, threads)
        _was_registered = True
    physx = ovphysx.PhysX()
    stage = ovstage.Stage("wheelleg_exp")
    try:
        ovstage.population.open_usd(stage, str(path), ordinal=1, domains=ovstage.PopulationDomain.ALL)
        stage.advance_write_floor(ordinal=1).wait()
        physx.wait_task(physx.attach_ovstage(stage, read_ordinal=1))
        physx.warmup()
    except Exception as error:  # The packages raise several classes of errors, with the reason as their text.
        message = f"PhysX cannot open the scene: {error}"
        raise ConfigError(message, key=_ASSET, expected="a USD file for PhysX") from error
    return physx, stage
