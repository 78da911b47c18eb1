import mujoco
import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.sim.physx.physx_stage import ROBOTS, links_of, write_scene

USD = assets_dir() / "wheelleg/wheelleg.usda"
GROUND = """<mujoco>
  <asset><hfield name="hills" nrow="3" ncol="4" size="1.5 1 .6 .1" elevation="0 1 2 3 4 5 6 7 8 9 8 6"/></asset>
  <worldbody>{}</worldbody>
</mujoco>"""


def staged(tmp_path, ground, num_envs=11, self_collisions=None):
    root, links = links_of(USD)
    path = tmp_path / "scene.usda"
    model = mujoco.MjModel.from_xml_string(GROUND.format(ground))
    write_scene(path, USD, root, links, model, num_envs, self_collisions)
    return Usd.Stage.Open(str(path)), model


def test_the_robots_are_the_usd_file_itself_and_report_their_contacts(tmp_path):
    stage, _ = staged(tmp_path, '<geom name="ground" type="plane" size="0 0 1"/>')
    robots = [prim.GetName() for prim in stage.GetPrimAtPath(ROBOTS).GetChildren() if prim.GetTypeName() == "Xform"]
    assert robots == [f"env_{i:02d}" for i in range(11)] == sorted(robots)
    original = Usd.Stage.Open(str(USD))
    masses = {}
    for name, where in (("wheelleg", original), ("env_07", stage)):
        top = where.GetPrimAtPath("/wheelleg" if where is original else f"{ROBOTS}/env_07")
        bodies = [prim for prim in Usd.PrimRange(top) if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
        masses[name] = {body.GetName(): UsdPhysics.MassAPI(body).GetMassAttr().Get() for body in bodies}
        thresholds = {body.GetAttribute("physxContactReport:threshold").Get() for body in bodies}
        assert thresholds == ({0.0} if name == "env_07" else {None})
    assert masses["wheelleg"] == masses["env_07"]
    assert len(masses["env_07"]) == 7


@pytest.mark.parametrize("wanted", [None, True, False])
def test_the_setting_of_self_collisions_overrides_the_file(tmp_path, wanted):
    stage, _ = staged(tmp_path, '<geom name="ground" type="plane" size="0 0 1"/>', 1, wanted)
    root, _ = links_of(USD)
    found = stage.GetPrimAtPath(f"{ROBOTS}/env_0/{root}").GetAttribute("physxArticulation:enabledSelfCollisions").Get()
    assert found == (True if wanted is None else wanted)


@pytest.mark.parametrize(
    "ground",
    ['<geom name="ground/a" type="hfield" hfield="hills" pos=".3 -.2 .1"/>',
     '<geom name="ground/b" type="box" size=".5 .4 .3" pos="1 2 3" euler="10 20 30"/>'],
)  # fmt: skip
def test_the_ground_has_the_surface_that_mujocos_rays_hit(tmp_path, ground):
    stage, model = staged(tmp_path, ground, 1)
    (prim,) = stage.GetPrimAtPath("/World/ground").GetChildren()
    mesh = UsdGeom.Mesh(prim)
    place = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    points = np.array(mesh.GetPointsAttr().Get(), dtype=float) @ place[:3, :3] + place[3, :3]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for corners in points[np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        for start in (corners.mean(axis=0), 0.6 * corners[0] + 0.2 * corners[1] + 0.2 * corners[2]):
            distance = mujoco.mj_ray(model, data, start + 1e-3 * normal, -normal, None, 1, -1, np.zeros(1, np.int32))
            assert distance == pytest.approx(1e-3, abs=1e-6)  # The faces' normals point outwards.


def test_what_physx_cannot_simulate_is_refused_by_its_key(tmp_path):
    urdf = tmp_path / "robot.urdf"
    with pytest.raises(ConfigError, match=r"env\.robot\.asset.*'robot\.urdf' is not one"):
        links_of(urdf)
    empty = tmp_path / "empty.usda"
    header = '#usda 1.0\n(defaultPrim = "a"\n metersPerUnit = {}\n upAxis = "Z")\ndef Xform "a"\n{{\n}}\n'
    empty.write_text(header.format(0.01))
    with pytest.raises(ConfigError, match=r"metersPerUnit and kilogramsPerUnit \(0\.01, 1\.0\)"):
        links_of(empty)
    rootless = tmp_path / "rootless.usda"
    rootless.write_text(header.format(1))
    with pytest.raises(ConfigError, match=r"articulation roots at: \(nowhere\)"):
        links_of(rootless)
    with pytest.raises(ConfigError, match=r"env\.scene\.terrain.*a geom of the type sphere"):
        staged(tmp_path, '<geom name="ground" type="sphere" size="1"/>', 1)


def test_joints_have_drives_and_none_leads_to_the_world(tmp_path):
    usd, model = tmp_path / "robot.usda", mujoco.MjModel.from_xml_string(GROUND.format(""))
    file = Usd.Stage.CreateNew(str(usd))
    UsdGeom.SetStageUpAxis(file, "Z")
    UsdGeom.SetStageMetersPerUnit(file, 1.0)
    file.SetDefaultPrim(file.DefinePrim("/robot", "Xform"))
    types = {"/robot/base": "Xform", "/robot/base/leg": "Xform", "/robot/base/imu": "Cube"}
    bodies = [file.DefinePrim(path, kind) for path, kind in types.items()]
    UsdPhysics.CollisionAPI.Apply(bodies[0])  # so the cube, a link itself, becomes a collider
    for body in bodies:
        UsdPhysics.RigidBodyAPI.Apply(body)
    UsdPhysics.ArticulationRootAPI.Apply(bodies[0])
    kinds = {"world": UsdPhysics.FixedJoint, "hip": UsdPhysics.RevoluteJoint, "mount": UsdPhysics.FixedJoint}
    for (name, kind), parent, child in zip(kinds.items(), ("/robot", *2 * ["/robot/base"]), bodies, strict=True):
        joint = kind.Define(file, f"/robot/{name}")
        joint.CreateBody0Rel().SetTargets([parent])
        joint.CreateBody1Rel().SetTargets([child.GetPath()])
    file.Save()
    write_scene(tmp_path / "scene.usda", usd, *links_of(usd), model, 1, None)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    robot = stage.GetPrimAtPath(f"{ROBOTS}/env_0").GetChildren()
    schemas = {prim.GetName(): [*prim.GetAppliedSchemas()] for prim in robot if prim.IsA(UsdPhysics.Joint)}
    assert schemas == {"hip": ["PhysicsDriveAPI:angular"], "mount": []}
    found = stage.GetPrimAtPath(f"{ROBOTS}/env_0/base/imu").GetMetadata("apiSchemas").GetAddedOrExplicitItems()
    assert {"PhysicsCollisionAPI", "PhysxContactReportAPI"} <= {*found}
    bodies[0].RemoveAPI(UsdPhysics.ArticulationRootAPI)
    UsdPhysics.ArticulationRootAPI.Apply(joint.GetPrim())
    file.Save()
    with pytest.raises(ConfigError, match="articulation root at the joint mount"):
        links_of(usd)
