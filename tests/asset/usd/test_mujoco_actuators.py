"""MjcActuator prims become MuJoCo's general actuators for all transmission types."""

import mujoco
import numpy as np
import pytest

from ..small_usd import converted, hinge, link, write

Trn = mujoco.mjtTrn
SITE = """
        def Sphere "{name}" (prepend apiSchemas = ["MjcSiteAPI"])
        {{
            double radius = 0.02; double3 xformOp:translate = {at}
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}"""


def actuator(target: str, text: str = "", name: str = "motor") -> str:
    return f'def MjcActuator "{name}" {{ rel mjc:target = </bot/{target}>\n{text}\n}}\n'


def pair(folder, text: str = "", *, target: str = "j", inside: str = "", joint: str = "", kind: str = "Revolute"):
    body = link("a", inside=SITE.format(name="here", at="(0, 0, 0.1)"))
    body += link("b", "(1, 0, 0)", inside=SITE.format(name="tip", at="(0.1, 0, 0)") + inside)
    body += hinge("j", "a", "b", kind=kind, text=f"point3f physics:localPos0 = (1, 0, 0)\n {joint}")
    return converted(write(folder, body + actuator(target, text)))


@pytest.mark.parametrize(
    ("text", "joint", "left_out"),
    [
        ("uniform int mjc:actDim = 3", "", ["actdim"]),
        ('uniform token mjc:dynType = "filter"; uniform int mjc:actDim = 0', "", ["actdim"]),
        ("uniform double mjc:crankLength = 2; uniform int mjc:actDim = 3", "", ["cranklength", "actdim"]),
        ("", "uniform double[] mjc:springdamper = [-1, 3]", ["springdamper"]),
    ],
)
def test_attributes_that_mujoco_refuses_are_left_out_by_name(text, joint, left_out, tmp_path):
    model, done = pair(tmp_path, f"uniform double[] mjc:gear = [3]\n{text}", joint=joint)
    assert (model.nu, model.actuator("motor").gear[0]) == (1, 3)  # All other attributes remain.
    refused = [item for item in done.report.left_out if item.reason.startswith("MuJoCo refuses it: ")]
    assert [item.name for item in refused] == left_out
    assert [text for text in done.report.warnings if f"the attribute {left_out[0]} = " in text]
    assert not [item for item in done.report.mapped if item.became in left_out]


def test_parameters_and_ranges_are_those_of_the_file(tmp_path):
    text = """uniform double[] mjc:gainPrm = [100, 0, 0]; uniform double[] mjc:biasPrm = [0, -100, -2, 0]
        uniform token mjc:biasType = "affine"; uniform double[] mjc:gear = [3, 0, 0, 0, 0, 0]; uniform int mjc:group = 2
        uniform double mjc:ctrlRange:min = -0.8; uniform double mjc:ctrlRange:max = 0.9
        uniform double mjc:forceRange:min = -23; uniform double mjc:forceRange:max = 24"""
    model, done = pair(tmp_path, text)
    motor = model.actuator("motor")
    assert (motor.trntype, motor.trnid[0]) == (int(Trn.mjTRN_JOINT), model.joint("j").id)
    assert (motor.gainprm[0], motor.gear[0], motor.group, done.report.totals["actuators"]) == (100, 3, 2, 1)
    np.testing.assert_allclose(motor.biasprm[:4], [0, -100, -2, 0])
    np.testing.assert_allclose([motor.ctrlrange, motor.forcerange], [[-0.8, 0.9], [-23, 24]])


@pytest.mark.parametrize(
    ("text", "dynamics", "states"),
    [
        ('uniform token mjc:dynType = "filterexact"\nuniform double[] mjc:dynPrm = [0.3]', "FILTEREXACT", 1),
        ('uniform token mjc:dynType = "integrator"\nuniform double mjc:actRange:max = 1', "INTEGRATOR", 1),
        ('uniform token mjc:dynType = "user"\nuniform int mjc:actDim = 2', "USER", 2),
    ],
)
def test_dynamics_have_their_states(tmp_path, text, dynamics, states):
    model, _ = pair(tmp_path, text)
    assert (model.actuator_dyntype[0], model.na) == (int(getattr(mujoco.mjtDyn, f"mjDYN_{dynamics}")), states)


UPPER = "uniform double mjc:ctrlRange:max = 2"
ACTIVE = """uniform token mjc:dynType = "filter"; uniform bool mjc:actEarly = 1
    uniform double mjc:actRange:min = -2; uniform double mjc:actRange:max = 3
    uniform double mjc:lengthRange:min = 0.1; uniform double mjc:lengthRange:max = 0.4"""
ACTIVATION = {"actrange": [-2, 3], "lengthrange": [0.1, 0.4], "actearly": 1, "actlimited": 1}


@pytest.mark.parametrize(
    ("text", "options", "expected"),
    [
        (UPPER, {}, {"ctrlrange": [0, 2], "ctrllimited": 1}),
        (f'uniform token mjc:ctrlLimited = "false"\n{UPPER}', {}, {"ctrllimited": 0}),
        ("uniform double[] mjc:gainPrm = [0, 0, 0]", {}, {"gainprm": [0] * 10}),
        (ACTIVE, {}, ACTIVATION),
        ("uniform bool mjc:jointInParent = 1", {"kind": "Spherical"}, {"trntype": int(Trn.mjTRN_JOINTINPARENT)}),
        (UPPER, {"target": "b"}, {"trntype": int(Trn.mjTRN_BODY), "trnid": [2, -1]}),
    ],
    ids=["one end of a range", "a range that is off", "no gain", "activation", "in the parent's frame", "adhesion"],
)
def test_attributes_become_those_of_mujoco(tmp_path, text, options, expected):
    model, _ = pair(tmp_path, text, **options)
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(model, f"actuator_{name}")[0], value, err_msg=name)


@pytest.mark.parametrize(("target", "text"), [("gone", ""), ("j", 'uniform token mjc:biasType = "magic"')])
def test_an_actuator_on_nothing_or_of_an_unknown_type_is_named_and_warned_about(tmp_path, target, text):
    model, done = pair(tmp_path, text, target=target)
    assert model.nu == 0
    assert any("/bot/motor" in warning for warning in done.report.warnings)
    assert "MjcActuator" in {item.name for item in done.report.left_out} or "magic" in str(done.report.warnings)


REFERENCE = "rel mjc:refSite = </bot/a/here>\n uniform double[] mjc:gear = [0, 0, 1, 0, 0, 0]"
CRANK = "rel mjc:sliderSite = </bot/a/here>\n uniform double mjc:crankLength = 1.3"


@pytest.mark.parametrize(("text", "kind", "crank"), [(REFERENCE, "SITE", 0), (CRANK, "SLIDERCRANK", 1.3)])
def test_a_site_is_driven_relative_to_another_site_or_by_a_crank(tmp_path, text, kind, crank):
    model, _ = pair(tmp_path, text, target="b/tip")
    assert model.actuator_trntype[0] == int(getattr(Trn, f"mjTRN_{kind}"))
    assert list(model.actuator_trnid[0]) == [model.site("tip").id, model.site("here").id]
    assert model.actuator_cranklength[0] == crank


DRIVEN = hinge("j", "a", "b", apis="PhysicsDriveAPI:angular", text="float drive:angular:physics:stiffness = 5")


def test_an_actuator_takes_the_place_of_the_joints_drive(tmp_path):
    body = link("a") + link("b", "(1, 0, 0)") + DRIVEN
    model, done = converted(write(tmp_path, body + actuator("j", "uniform double[] mjc:gainPrm = [7]")))
    assert [model.actuator(i).name for i in range(model.nu)] == ["motor"]
    assert "drive:angular:physics:stiffness" in {item.name for item in done.report.left_out}


def test_an_actuator_called_like_a_driven_joint_gets_another_name(tmp_path):
    own = f'def Scope "own" {{\n{actuator("c", name="j")}\n}}\n'
    model, _ = converted(write(tmp_path, link("a") + link("b", "(1, 0, 0)") + link("c", "(2, 0, 0)") + DRIVEN + own))
    assert [model.actuator(i).name for i in range(model.nu)] == ["j", "j_2"]


LOWER = "float physics:lowerLimit = -30\n"


@pytest.mark.parametrize(
    ("limits", "inherited"), [("", False), (LOWER, False), (LOWER + "float physics:upperLimit = 40", True)]
)
def test_controls_inherit_a_range_only_where_there_is_one(tmp_path, limits, inherited):
    gains = "uniform double[] mjc:gainPrm = [5]\n uniform double[] mjc:biasPrm = [0, -5, 0]\n"
    motor = actuator("j", gains + 'double mjc:inheritRange = 0.5\n uniform token mjc:biasType = "affine"')
    model, done = converted(write(tmp_path, link("a") + link("b") + hinge("j", "a", "b", text=limits) + motor))
    expected = np.radians([-12.5, 22.5] if inherited else [0, 0])
    np.testing.assert_allclose(model.actuator("motor").ctrlrange, expected, rtol=1e-6)
    assert any("inheritRange" in warning for warning in done.report.warnings) is not inherited
