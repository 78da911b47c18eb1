"""The stock robot's MuJoCo model agrees with closed forms and with the robot description."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Sdf, Usd, UsdPhysics

from wheelleg_exp.asset import Conversion

from ..small_usd import tensor

THIGH = SHANK = 0.0425
WHEEL = 0.020
HIP, KNEE = 0.9599, -1.8850
BOX_HALF = np.array([0.040, 0.035, 0.018])
SIDES = ("l", "r")


@pytest.fixture(scope="module")
def model(conversion: Conversion) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(conversion.output))


@pytest.fixture
def home(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("schema", ["physxJoint", "physxJointAxis:angular"])
def test_old_and_new_versions_of_physx_read_armature_and_velocity_limit(source: Path, schema: str):
    """PhysX (ovphysx 0.6 or newer) ignores PhysxJointAPI; Isaac Sim 4.5 does not know PhysxJointAxisAPI."""
    stage = Usd.Stage.Open(str(source))
    for prim in stage.Traverse():
        if prim.IsA(UsdPhysics.RevoluteJoint):
            api, _, instance = schema.partition(":")
            name = f"{api[0].upper()}{api[1:]}API" + (f":{instance}" if instance else "")
            assert name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
            assert prim.GetAttribute(f"{schema}:armature").Get() == pytest.approx(0.05)
            speed = 45 if prim.GetName().endswith("03") else 30
            assert math.radians(prim.GetAttribute(f"{schema}:maxJointVelocity").Get()) == pytest.approx(speed)


def capsule_moments_about_z(mass: float, radius: float, length: float) -> np.ndarray:
    z = np.linspace(-length / 2 - radius, length / 2 + radius, 200_001)
    beyond = np.clip(np.abs(z) - length / 2, 0, None)
    squared = np.clip(radius**2 - beyond**2, 0, None)
    weight = squared / squared.sum() * mass
    across = np.sum(weight * (squared / 4 + z**2))
    return np.array([across, across, np.sum(weight * squared / 2)])


def test_weighs_half_a_kilogram_with_its_centre_of_mass_ahead_of_the_hips(model):
    masses = {"base_link": 0.28}
    masses |= {f"{s}_{part}_link": m for s in SIDES for part, m in (("thigh", 0.03), ("shank", 0.02), ("wheel", 0.06))}
    for body, mass in masses.items():
        assert model.body(body).mass[0] == pytest.approx(mass, rel=1e-6)
    assert model.body_subtreemass[0] == pytest.approx(0.50, rel=1e-6)
    np.testing.assert_allclose(model.body("base_link").ipos, [0.0051, 0, 0], atol=1e-8)


@pytest.mark.parametrize("side", SIDES)
def test_inertias_are_those_of_the_solid_shapes(model, side):
    x, y, z = BOX_HALF**2
    across = 0.06 * (WHEEL**2 / 4 + 0.012**2 / 12)
    expected = {
        "base_link": 0.28 / 3 * np.array([y + z, x + z, x + y]),
        f"{side}_thigh_link": capsule_moments_about_z(0.03, 0.005, THIGH),
        f"{side}_shank_link": capsule_moments_about_z(0.02, 0.004, SHANK),
        f"{side}_wheel_link": [across, 0.06 * WHEEL**2 / 2, across],
    }
    for body, moments in expected.items():
        np.testing.assert_allclose(tensor(model, body), np.diag(moments), rtol=1e-5, atol=1e-12)


def test_stands_over_its_axle_at_the_height_of_the_leg_geometry(home):
    assert home.subtree_com[0][0] == pytest.approx(home.body("l_wheel_link").xpos[0], abs=1e-5)
    formula = WHEEL + THIGH * math.cos(HIP) + SHANK * math.cos(HIP + KNEE)
    measured = WHEEL + home.body("base_link").xpos[2] - home.body("l_wheel_link").xpos[2]
    assert (formula, measured) == (pytest.approx(0.06995, abs=1e-5), pytest.approx(formula, abs=1e-7))


@pytest.mark.parametrize("side", SIDES)
def test_zero_is_a_leg_straight_down(model, side):
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    sign = 1 if side == "l" else -1
    np.testing.assert_allclose(data.body(f"{side}_thigh_link").xpos, [0, sign * 0.040, 0], atol=1e-9)
    np.testing.assert_allclose(data.body(f"{side}_shank_link").xpos, [0, sign * 0.048, -THIGH], atol=1e-9)
    wheel = data.body(f"{side}_wheel_link").xpos
    np.testing.assert_allclose(wheel, [0, sign * 0.056, -THIGH - SHANK], atol=1e-9)


def test_every_hinge_turns_about_plus_y(model, home):
    for joint in ("l01", "l02", "l03", "r01", "r02", "r03"):
        np.testing.assert_allclose(home.joint(joint).xaxis, [0, 1, 0], atol=1e-9)


@pytest.mark.parametrize("side", SIDES)
def test_positive_hip_angle_brings_the_knee_to_the_back(model, side):
    data = mujoco.MjData(model)
    data.joint(f"{side}01").qpos = 0.5
    mujoco.mj_kinematics(model, data)
    assert data.body(f"{side}_shank_link").xpos[0] == pytest.approx(-THIGH * math.sin(0.5))


@pytest.mark.parametrize("side", SIDES)
def test_positive_wheel_speed_drives_forward(model, home, side):
    home.joint(f"{side}03").qvel = 10.0
    jacobian = np.zeros((3, model.nv))
    ground = home.body(f"{side}_wheel_link").xpos - [0, 0, WHEEL]
    mujoco.mj_jac(model, home, jacobian, None, ground, model.body(f"{side}_wheel_link").id)
    slip = jacobian @ home.qvel  # tyre at the contact point
    np.testing.assert_allclose(slip, [-10.0 * WHEEL, 0, 0], atol=1e-9)


def test_joints_have_the_limits_and_the_armature_of_the_file(model, conversion):
    for side in SIDES:
        np.testing.assert_allclose(model.joint(f"{side}01").range, [-0.5, 1.7], atol=1e-6)
        np.testing.assert_allclose(model.joint(f"{side}02").range, [-2.6, -0.3], atol=1e-6)
        assert not model.jnt_limited[model.joint(f"{side}03").id]
    np.testing.assert_allclose(model.dof_armature[6:], 0.05)
    limits = conversion.report.velocity_limits
    assert limits == {**dict.fromkeys(("l01", "l02", "r01", "r02"), 30.0), **dict.fromkeys(("l03", "r03"), 45.0)}


def test_drives_are_per_radian(model):
    for side in SIDES:
        for joint in (f"{side}01", f"{side}02"):
            drive = model.actuator(joint)
            np.testing.assert_allclose(drive.gainprm[0], 3.0, rtol=1e-6)
            np.testing.assert_allclose(drive.biasprm[:3], [0, -3.0, -0.3], rtol=1e-6)
            np.testing.assert_allclose(drive.forcerange, [-2.0, 2.0])
        wheel = model.actuator(f"{side}03")
        np.testing.assert_allclose(wheel.biasprm[:3], [0, 0, -1.0], rtol=1e-6)
        np.testing.assert_allclose(wheel.forcerange, [-9.0, 9.0])


def test_the_saved_state_and_the_targets_are_the_default_pose(model):
    pose = [HIP, KNEE, 0.0, HIP, KNEE, 0.0]
    np.testing.assert_allclose(model.key("home").qpos[7:], pose, atol=1e-6)
    np.testing.assert_allclose(model.key("home").ctrl, pose, atol=1e-6)


def test_orders_of_either_simulator_are_reported(conversion, model):
    assert conversion.report.dof_order.physx == ("l01", "r01", "l02", "r02", "l03", "r03")
    assert conversion.report.dof_order.mujoco == tuple(model.joint(i).name for i in range(1, model.njnt))


def test_colliders_are_the_stated_shapes(model):
    expected = {"base_link_box": BOX_HALF}
    for side in SIDES:
        expected[f"{side}_thigh_link_capsule"] = [0.005, THIGH / 2, 0]
        expected[f"{side}_shank_link_capsule"] = [0.004, SHANK / 2, 0]
        expected[f"{side}_wheel_link_cylinder"] = [WHEEL, 0.006, 0]
    solid = [model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i]]
    assert sorted(solid) == sorted(expected)
    for name, size in expected.items():
        np.testing.assert_allclose(model.geom(name).size, size, atol=1e-12)
        assert model.geom(name).group[0] == 3


def test_stands_on_its_wheels_alone(conversion):
    spec = mujoco.MjSpec.from_file(str(conversion.output))
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] = 0.0699
    mujoco.mj_forward(model, data)
    touching = {model.geom(g).name for contact in data.contact for g in contact.geom}
    assert touching == {"ground", "l_wheel_link_cylinder", "r_wheel_link_cylinder"}


def test_pairs_within_a_leg_never_touch_and_all_others_may(model):
    excluded = {frozenset(divmod(int(pair), 1 << 16)) for pair in model.exclude_signature}
    expected = set()
    for side in SIDES:
        thigh, shank, wheel = (model.body(f"{side}_{part}_link").id for part in ("thigh", "shank", "wheel"))
        expected |= {frozenset(pair) for pair in ((thigh, shank), (shank, wheel), (thigh, wheel))}
        expected |= {frozenset((model.body("base_link").id, thigh))}
    assert excluded == expected
    solid = model.geom_contype > 0
    assert (model.geom_contype[solid] & model.geom_conaffinity[solid]).all()


def test_visuals_weigh_nothing_and_touch_nothing(model):
    visuals = [i for i in range(model.ngeom) if model.geom(i).name.endswith("_visual")]
    assert not (model.geom_contype[visuals] | model.geom_conaffinity[visuals]).any()
    assert set(model.geom_group[visuals]) == {2}
    for side in SIDES:  # the rotation of a wheel can be seen
        marker = model.geom(f"{side}_wheel_link_valve_visual")
        assert math.hypot(marker.pos[0], marker.pos[2]) > 0.01
        assert marker.matid[0] != model.geom(f"{side}_wheel_link_tyre_visual").matid[0]


# ------------------------------------------------------------------ the USD itself
@pytest.fixture(scope="module")
def stage(source: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(source))


def test_is_laid_out_as_the_urdf_importer_lays_robots_out(stage):
    root = stage.GetDefaultPrim()
    sets = root.GetVariantSets()
    assert {name: sets.GetVariantSelection(name) for name in sets.GetNames()} == {
        "Physics": "PhysX",
        "Sensor": "Sensors",
    }
    links = [p.GetName() for p in root.GetChild("wl2").GetChildren()]
    assert (links[0], len(links)) == ("base_link", 7)
    for link in root.GetChild("wl2").GetChildren():
        for child in ("visuals", "collisions"):
            assert link.GetChild(child).IsInstance(), link.GetPath()
    joints = [p.GetName() for p in root.GetChild("joints").GetChildren()]
    assert joints == ["l01", "l02", "l03", "r01", "r02", "r03"]


def test_floats_and_its_links_are_drawn_where_the_joints_put_them(stage, conversion):
    joints = [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Joint)]
    assert all(UsdPhysics.Joint(j).GetBody0Rel().GetTargets() for j in joints)
    assert conversion.report.base == "floating"
    assert not [a for a in conversion.report.assumptions if "drawn" in a.rule]


def test_every_layer_refers_to_others_by_relative_paths(source):
    layers = [source, *sorted((source.parent / "configuration").glob("*.usda"))]
    assert len(layers) == 4
    for path in layers:
        for dependency in filter(None, Sdf.Layer.FindOrOpen(str(path)).GetCompositionAssetDependencies()):
            assert not Path(dependency).is_absolute()
            assert (path.parent / dependency).is_file()


def test_without_the_physics_variant_only_the_looks_are_left(source):
    stage = Usd.Stage.Open(str(source))
    stage.GetDefaultPrim().GetVariantSet("Physics").SetVariantSelection("None")
    prims = list(Usd.PrimRange(stage.GetDefaultPrim(), Usd.TraverseInstanceProxies()))
    assert not any(prim.HasAPI(UsdPhysics.RigidBodyAPI) for prim in prims)
    assert any(prim.GetName() == "tyre" for prim in prims)
