"""Attributes of MuJoCo's and Newton's USD schemas become MuJoCo attributes, shown on small files."""

import math

import mujoco
import numpy as np
import pytest

from ..small_usd import MASS, SI, applied, converted, hinge, link, two_links, write

FOLLOWED = link("a") + link("b") + link("c") + hinge("ab", "a", "b")


def test_ref_is_the_coordinate_of_the_authored_pose(tmp_path):
    model, _ = two_links(tmp_path, "double mjc:ref = 30")
    data = mujoco.MjData(model)
    data.joint("j").qpos = math.radians(30)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("b").xmat.reshape(3, 3), np.eye(3), atol=1e-7)
    assert model.key("home").qpos[-1] == pytest.approx(math.radians(30))


@pytest.mark.parametrize(("adds", "dofs"), [(True, 2), (False, 1)])
def test_two_joints_between_two_bodies_add_up_only_if_the_file_allows_it(tmp_path, adds, dofs):
    switch = "bool newton:jointsAddMobility = 1" if adds else ""
    first = link("a", apis="PhysicsArticulationRootAPI").replace("float physics:mass", f"{switch}\n float physics:mass")
    axis = 'uniform token physics:axis = "{}"'
    slides = "".join(hinge(name, "a", "b", kind="Prismatic", text=axis.format(name)) for name in "XY")
    model, done = converted(write(tmp_path, first + link("b") + slides))
    assert (model.nv - 6, model.neq) == (dofs, 0)
    assert any("closes a loop" in warning for warning in done.report.warnings) is not adds


MOTORS = "double mjc:actuatorfrcrange:min = -3\n double mjc:actuatorfrcrange:max = 4"


@pytest.mark.parametrize(("text", "limits"), [(MOTORS, [-3, 4]), ("float urdf:limit:effort = 16", [-16, 16])])
def test_the_sum_of_motors_is_limited(tmp_path, text, limits):
    model, _ = two_links(tmp_path, text)
    np.testing.assert_allclose(model.jnt_actfrcrange[1], limits)


@pytest.mark.parametrize("kind", ["Revolute", "Prismatic"])
@pytest.mark.parametrize("units", ["", "metersPerUnit = 0.01\n kilogramsPerUnit = 0.001\n"])
def test_attributes_of_a_urdf_are_in_its_units_whatever_those_of_the_stage(tmp_path, kind, units):
    names = ("limit:effort", "limit:velocity", "dynamics:friction", "dynamics:damping")
    text = "\n".join(f"float urdf:{name} = {value}" for name, value in zip(names, (16, 5, 0.2, 0.3), strict=True))
    header = units + (SI.replace("metersPerUnit = 1\n", "") if units else SI)
    mass = MASS.replace("0.1, 0.1, 0.1", "1e6, 1e6, 1e6")
    joint = hinge("j", "a", "b", kind=kind, text=text)
    model, done = converted(write(tmp_path, link("a", mass=mass) + link("b", mass=mass) + joint, header=header))
    np.testing.assert_allclose(model.jnt_actfrcrange[1], [-16, 16])
    np.testing.assert_allclose([model.dof_frictionloss[6], model.dof_damping[6]], [0.2, 0.3])
    assert done.report.velocity_limits == {"j": 5}


# ------------------------------------------------------------------ joints and bodies
def test_constraint_parameters_of_a_joint(tmp_path):
    text = """uniform double[] mjc:solreflimit = [0.03, 0.8]; double mjc:frictionloss = 0.1
        uniform double[] mjc:solimplimit = [0.8, 0.9, 0.01, 0.5, 2]; uniform double[] mjc:solreffriction = [0.04, 0.7]
        uniform double[] mjc:solimpfriction = [0.7, 0.8, 0.02, 0.5, 2]; uniform bool mjc:actuatorgravcomp = 1
        uniform double mjc:margin = 0.01; uniform int mjc:group = 3
        float physics:lowerLimit = -10; float physics:upperLimit = 10"""
    model, _ = two_links(tmp_path, text)
    np.testing.assert_allclose(model.jnt_solref[1], [0.03, 0.8])
    np.testing.assert_allclose(model.jnt_solimp[1], [0.8, 0.9, 0.01, 0.5, 2])
    np.testing.assert_allclose(model.dof_solref[6], [0.04, 0.7])
    np.testing.assert_allclose(model.dof_solimp[6], [0.7, 0.8, 0.02, 0.5, 2])
    assert (model.jnt_margin[1], model.jnt_group[1], model.jnt_actgravcomp[1]) == (0.01, 3, 1)


@pytest.mark.parametrize(("unit", "expected"), [("", math.radians(0.5)), ("radian", 0.5)])
def test_angles_of_mujocos_schemas_are_in_the_unit_of_its_compiler(tmp_path, unit, expected):
    text = f'uniform token mjc:compiler:angle = "{unit}"' if unit else ""
    joint = "double mjc:ref = 0.5\n double mjc:springref = 0.5\n double mjc:stiffness = 2"
    model = with_scene(tmp_path, text, hinge("j", "a", "b", text=joint))
    np.testing.assert_allclose([model.qpos0[-1], model.qpos_spring[-1]], [expected, expected], rtol=1e-6)
    model, _ = two_links(tmp_path, joint, kind="Prismatic")
    assert model.qpos_spring[-1] == 0.5  # metres


def test_springdamper_is_made_of_the_inertia_that_the_joint_meets(tmp_path):
    """MuJoCo's springdamper (t, d) gives the stiffness 1/(t² d²)·I and the damping 2/t·I."""
    model, _ = two_links(tmp_path, "uniform double[] mjc:springdamper = [0.5, 0.8]")
    assert model.dof_damping[6] > 0
    ratio = model.jnt_stiffness[1] / model.dof_damping[6]
    assert ratio == pytest.approx(1 / (0.5 * 0.8) ** 2 / (2 / 0.5))


def test_gravity_may_be_lifted_in_part(tmp_path):
    model, _ = converted(write(tmp_path, link("a", mass=MASS + "\n        custom float mjc:body:gravcomp = 0.25")))
    assert model.body_gravcomp[1] == 0.25


# ------------------------------------------------------------------ couplings and closures


PLAIN = "rel newton:mimicJoint = </bot/ab>\n float newton:mimicCoef0 = 90\n float newton:mimicCoef1 = -2"
RADIANS = "rel mjc:target = </bot/ab>\n float newton:mimicCoef0 = 90\n uniform double mjc:coef0 = 0.25"
POLYNOMIAL = """rel newton:mimicJoint = </bot/ab>; bool newton:mimicEnabled = 0; uniform double mjc:coef2 = 3
    uniform double mjc:coef4 = 5; uniform double[] mjc:solref = [0.01, 1]"""


@pytest.mark.parametrize(
    ("apis", "text", "polynomial"),
    [
        ("NewtonMimicAPI", PLAIN, [math.pi / 2, -2, 0, 0, 0]),
        ("MjcEqualityJointAPI", RADIANS, [0.25, 1, 0, 0, 0]),
        ("NewtonMimicAPI MjcEqualityJointAPI", POLYNOMIAL, [0, 1, 3, 0, 5]),
    ],
)
def test_a_joint_that_follows_another_is_an_equality(tmp_path, apis, text, polynomial):
    model, _ = converted(write(tmp_path, FOLLOWED + hinge("bc", "b", "c", apis=apis, text=text)))
    assert list(model.eq_type) == [mujoco.mjtEq.mjEQ_JOINT]
    assert (model.eq_obj1id[0], model.eq_obj2id[0]) == (model.joint("bc").id, model.joint("ab").id)
    np.testing.assert_allclose(model.eq_data[0][:5], polynomial, rtol=1e-6)
    np.testing.assert_allclose(model.eq_solref[0], [0.01 if text == POLYNOMIAL else 0.02, 1])
    assert bool(model.eq_active0[0]) is (text != POLYNOMIAL)


@pytest.mark.parametrize(("kind", "api"), [("Spherical", "Connect"), ("Fixed", "Weld")])
def test_a_loop_has_the_stiffness_of_the_file(tmp_path, kind, api):
    text = "uniform bool physics:excludeFromArticulation = 1\n uniform double[] mjc:solref = [0.005, 1]\n"
    text += "uniform double[] mjc:solimp = [0.8, 0.9, 0.01, 0.5, 2]\n uniform float mjc:torqueScale = 3"
    body = link("a") + link("b", "(1, 0, 0)") + hinge("ab", "a", "b", text="point3f physics:localPos0 = (1, 0, 0)")
    loop = hinge("loop", "a", "b", kind=kind, apis=f"MjcEquality{api}API", text=text)
    model, _ = converted(write(tmp_path, body + loop))
    (equality,) = range(model.neq)
    np.testing.assert_allclose(model.eq_solref[equality], [0.005, 1])
    np.testing.assert_allclose(model.eq_solimp[equality], [0.8, 0.9, 0.01, 0.5, 2])
    if api == "Weld":
        assert model.eq_data[equality][10] == 3


# ------------------------------------------------------------------ shapes
def contact_of(folder, text: str, material: str = "") -> tuple[mujoco.MjModel, int]:
    apis = "PhysicsCollisionAPI MjcCollisionAPI NewtonCollisionAPI MaterialBindingAPI"
    bound = "rel material:binding:physics = </bot/rubber>" if material else ""
    inside = f'def Sphere "ball" {applied(apis)} {{ {bound}\n {text}\n }}'
    if material:
        material = f'def Material "rubber" {applied("PhysicsMaterialAPI NewtonMaterialAPI")} {{ {material}\n }}'
    model, _ = converted(write(folder, link("a", inside=inside) + material))
    return model, model.geom("a_ball").id


def test_contact_parameters_of_a_shape(tmp_path):
    text = """uniform int mjc:condim = 6; uniform int mjc:priority = 2; uniform int mjc:group = 4
        uniform double mjc:solmix = 0.5; uniform double[] mjc:solref = [0.01, 0.9]
        uniform double[] mjc:solimp = [0.015, 1, 0.03, 0.5, 2]
        float newton:contactMargin = 0.25; float newton:contactGap = 0.125"""
    model, geom = contact_of(tmp_path, text)
    assert (model.geom_condim[geom], model.geom_priority[geom], model.geom_group[geom]) == (6, 2, 4)
    assert (model.geom_solmix[geom], model.geom_margin[geom], model.geom_gap[geom]) == (0.5, 0.25, 0.125)
    np.testing.assert_allclose(model.geom_solref[geom], [0.01, 0.9])
    np.testing.assert_allclose(model.geom_solimp[geom], [0.015, 1, 0.03, 0.5, 2])


def test_mujocos_margin_wins_over_newtons_and_infinity_is_unset(tmp_path):
    text = "float newton:contactMargin = 0.25\n float newton:contactGap = -inf\n uniform double mjc:margin = 0.5"
    model, geom = contact_of(tmp_path, text)
    assert (model.geom_margin[geom], model.geom_gap[geom]) == (0.5, 0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("float newton:torsionalFriction = 0.25\n float newton:rollingFriction = 0.5", (0.75, 0.25, 0.5)),
        ("float newton:torsionalFriction = 0.25\n double mjc:torsionalfriction = 0.125", (0.75, 0.125, 1e-4)),
        ("", (0.75, 0.005, 1e-4)),
    ],
)
def test_friction_in_all_directions(tmp_path, text, expected):
    model, geom = contact_of(tmp_path, "", "float physics:dynamicFriction = 0.75\n" + text)
    np.testing.assert_allclose(model.geom_friction[geom], expected)


def test_a_value_of_another_length_is_left_out_with_a_warning(tmp_path):
    apis = applied("PhysicsCollisionAPI MjcCollisionAPI")
    ball = f'def Sphere "ball" {apis} {{ uniform double[] mjc:solref = [1, 2, 3, 4]\n }}'
    model, done = converted(write(tmp_path, link("a", inside=ball)))
    np.testing.assert_allclose(model.geom_solref[0], [0.02, 1])
    assert any("solref" in warning for warning in done.report.warnings)


def test_a_site_is_no_geom_and_has_the_shape_and_place_of_its_prim(tmp_path):
    site = """def Capsule "{name}" (prepend apiSchemas = ["MjcSiteAPI"])
        {{
            double radius = 0.1; double height = 0.6; uniform token axis = "Z"; uniform int mjc:group = 4
            color3f[] primvars:displayColor = [(1, 0, 0)]; double3 xformOp:translate = (0.1, 0.2, 2)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}"""
    model, _ = converted(write(tmp_path, link("a", inside=site.format(name="tip")) + site.format(name="goal")))
    assert model.ngeom == 0
    for name, body in (("tip", "a"), ("goal", "world")):
        found = model.site(name)
        assert (found.bodyid[0], found.type[0]) == (model.body(body).id, int(mujoco.mjtGeom.mjGEOM_CAPSULE))
        np.testing.assert_allclose(found.size[:2], [0.1, 0.3])
        np.testing.assert_allclose(found.rgba, [1, 0, 0, 1])
        np.testing.assert_allclose(found.pos, [0.1, 0.2, 2])
        assert found.group[0] == 4


# ------------------------------------------------------------------ the scene
def with_scene(folder, text: str, more: str = "", **options: object) -> mujoco.MjModel:
    scene = f'def PhysicsScene "scene" {applied("MjcSceneAPI NewtonSceneAPI")}\n{{\n{text}\n}}\n'
    body = link("a") + (link("b") if "b>" in more else "") + more
    return converted(write(folder, body, outside=scene), **options)[0]


def test_options_that_change_the_model_are_read(tmp_path):
    text = """uniform token mjc:option:integrator = "implicitfast"; uniform token mjc:option:cone = "elliptic"
        uniform double mjc:option:impratio = 10; uniform double mjc:option:density = 1.2
        uniform double3 mjc:option:wind = (1, 0, 0); uniform int[] mjc:option:actuatorgroupdisable = [1, 3]
        uniform bool mjc:flag:eulerdamp = 0; uniform bool mjc:flag:contact = 0; uniform bool mjc:flag:energy = 1"""
    option = with_scene(tmp_path, text).opt
    assert option.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    assert option.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC)
    assert (option.impratio, option.density, option.disableactuator) == (10, 1.2, 0b1010)
    np.testing.assert_allclose(option.wind, [1, 0, 0])
    off = mujoco.mjtDisableBit
    assert option.disableflags == int(off.mjDSBL_EULERDAMP) | int(off.mjDSBL_CONTACT)
    assert option.enableflags == int(mujoco.mjtEnableBit.mjENBL_ENERGY)


def test_steps_and_solvers_belong_to_the_task(tmp_path):
    text = "uniform double mjc:option:timestep = 0.01\n uniform int mjc:option:iterations = 3"
    scene = f'def PhysicsScene "scene" {applied("MjcSceneAPI")} {{ {text}\n }}'
    model, done = converted(write(tmp_path, link("a"), outside=scene))
    assert (model.opt.timestep, model.opt.iterations) == (0.002, 100)
    left = {item.name: item.reason for item in done.report.left_out}
    assert all("task" in left[f"mjc:option:{name}"] for name in ("timestep", "iterations"))


@pytest.mark.parametrize(
    ("text", "mass", "moment"),
    [
        ("uniform double mjc:compiler:setTotalMass = 3", 3, 0.3),
        ("uniform double mjc:compiler:boundMass = 2", 2, 0.1),
        ("uniform double mjc:compiler:boundInertia = 0.5", 1, 0.5),
    ],
)
def test_masses_are_what_the_scenes_compiler_makes_of_them(tmp_path, text, mass, moment):
    model = with_scene(tmp_path, text)
    assert model.body_mass[1] == pytest.approx(mass)
    np.testing.assert_allclose(model.body_inertia[1], [moment] * 3)


def test_a_keyframe_is_read_and_one_of_another_size_is_named(tmp_path):
    keys = 'def MjcKeyframe "crouch" { double[] mjc:qpos = [0, 0, 1, 1, 0, 0, 0]; }\n'
    keys += 'def MjcKeyframe "other" { double[] mjc:qpos = [1, 2]; }\n'
    model, done = converted(write(tmp_path, link("a") + keys))
    np.testing.assert_allclose(model.key("crouch").qpos, [0, 0, 1, 1, 0, 0, 0])
    assert [model.key(i).name for i in range(model.nkey)] == ["home", "crouch"]
    assert any("/bot/other" in warning for warning in done.report.warnings)
