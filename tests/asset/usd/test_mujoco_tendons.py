"""MjcTendon prims become MuJoCo tendons: coordinate sums, and paths through sites, around geoms, and over pulleys."""

import math

import mujoco
import numpy as np
import pytest

from ..small_usd import converted, hinge, link, write
from .test_mujoco_actuators import SITE, actuator


def tendon(text: str, kind: str = "spatial") -> str:
    return f'def MjcTendon "cord" {{ uniform token mjc:type = "{kind}"\n{text}\n}}\n'


DRUM = '\ndef Cylinder "drum" { uniform token purpose = "guide"; double radius = 0.1; double height = 0.4; }\n'


def chain(folder, extra: str, inside: str = ""):
    body = ""
    for i, name in enumerate("abc"):
        site = SITE.format(name=f"s{i}", at="(0, 0.5, 0)")
        body += link(name, f"({i}, 0, 0)", inside=site + (inside if i == 1 else ""))
    for i, (one, other) in enumerate(("ab", "bc")):
        body += hinge(f"j{i}", one, other, text="point3f physics:localPos0 = (1, 0, 0)")
    return converted(write(folder, body + extra))


def lengths(model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.ten_length


SITES = "rel mjc:path = [</bot/a/s0>, </bot/b/s1>, </bot/c/s2>]\n"


def test_a_fixed_tendon_is_a_sum_of_coordinates(tmp_path):
    text = """rel mjc:path = [</bot/j0>, </bot/j1>]; uniform int[] mjc:path:indices = [0, 1]
        uniform double[] mjc:path:coef = [0.5, -2]; uniform double mjc:stiffness = 3; uniform double mjc:width = 0.01
        uniform double mjc:range:min = -1; uniform double mjc:range:max = 1.5"""
    model, _ = chain(tmp_path, tendon(text, "fixed"))
    assert model.ntendon == 1
    data = mujoco.MjData(model)
    data.joint("j0").qpos, data.joint("j1").qpos = 0.3, 0.1
    mujoco.mj_forward(model, data)
    assert data.ten_length[0] == pytest.approx(0.5 * 0.3 - 2 * 0.1)
    np.testing.assert_allclose(model.tendon_range[0], [-1, 1.5])
    assert (model.tendon_limited[0], model.tendon_stiffness[0]) == (1, 3)


PULLEYS = "uniform int[] mjc:path:indices = [0, 1, 1, 2]; uniform int[] mjc:path:segments = [0, 0, 1, 1]\n"
FIRST = "uniform int[] mjc:path:indices = [0, 1]; uniform int[] mjc:path:segments = [0, 0]\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("uniform int[] mjc:path:indices = [0, 2, 1]", 2 + 1),
        (PULLEYS + "uniform double[] mjc:path:divisors = [1, 4]", 1 + 1 / 4),
        (FIRST + "uniform double[] mjc:path:divisors = [2]", 1 / 2),
    ],
    ids=["order of the indices", "pulleys", "a first divisor is a pulley too"],
)
def test_a_spatial_tendon_goes_through_its_sites_and_is_divided_by_its_pulleys(tmp_path, text, expected):
    model, _ = chain(tmp_path, tendon(SITES + text))
    assert lengths(model)[0] == pytest.approx(expected)


@pytest.mark.parametrize("side", [False, True])
def test_a_tendon_goes_around_a_shape_that_nothing_draws(tmp_path, side):
    below = SITE.format(name="below", at="(0, -0.3, 0)")
    text = "rel mjc:path = [</bot/a/s0>, </bot/b/drum>, </bot/c/s2>]\n"
    if side:
        text += "rel mjc:sideSites = </bot/b/below>\nuniform int[] mjc:sideSites:indices = [-1, 0, -1]"
    model, _ = chain(tmp_path, tendon(text), inside=DRUM + below)
    assert model.ngeom == 1
    assert not (model.geom_contype | model.geom_conaffinity).any()
    # The path over the top is straight. The path below consists of two tangents and an arc.
    away = math.hypot(1, 0.5)
    tangent = math.sqrt(away**2 - 0.1**2)
    arc = 0.1 * (2 * math.pi - 2 * math.acos(0.1 / away) - 2 * math.atan2(1, 0.5))
    assert lengths(model)[0] == pytest.approx(2 * tangent + arc if side else 2.0, rel=1e-6)


def test_springs_limits_and_looks_of_a_tendon(tmp_path):
    text = """uniform double mjc:damping = 2; uniform double mjc:armature = 0.1; uniform double mjc:frictionloss = 0.2
        uniform double mjc:margin = 0.01; uniform double mjc:width = 0.01; uniform int mjc:group = 3
        uniform double[] mjc:springlength = [0.5, 0.7]; uniform double[] mjc:solreflimit = [0.03, 0.9]
        uniform double[] mjc:solimpfriction = [0.8, 0.9, 0.01, 0.5, 2]; uniform color4f mjc:rgba = (1, 0, 0, 0.5)
        uniform double mjc:actuatorfrcrange:min = -5; uniform double mjc:actuatorfrcrange:max = 6"""
    model, _ = chain(tmp_path, tendon(SITES + text))
    plain = [getattr(model, f"tendon_{key}")[0] for key in ("armature", "frictionloss", "margin", "group", "width")]
    np.testing.assert_allclose(plain, [0.1, 0.2, 0.01, 3, 0.01])
    assert model.tendon_damping[0] == 2
    np.testing.assert_allclose(model.tendon_lengthspring[0], [0.5, 0.7])
    np.testing.assert_allclose(model.tendon_solref_lim[0], [0.03, 0.9])
    np.testing.assert_allclose(model.tendon_solimp_fri[0][:3], [0.8, 0.9, 0.01])
    np.testing.assert_allclose(model.tendon_actfrcrange[0], [-5, 6])
    np.testing.assert_allclose(model.tendon_rgba[0], [1, 0, 0, 0.5])


def test_an_actuator_pulls_a_tendon(tmp_path):
    model, _ = chain(tmp_path, tendon(SITES) + actuator("cord"))
    kind = int(mujoco.mjtTrn.mjTRN_TENDON)
    assert (model.actuator_trntype[0], model.actuator_trnid[0][0]) == (kind, model.tendon("cord").id)


@pytest.mark.parametrize(
    "text",
    [
        "rel mjc:path = [</bot/a/s0>, </bot/gone>]",
        SITES + "uniform int[] mjc:path:indices = [0, 7]",
        SITES + "uniform int[] mjc:path:segments = [0]",
        SITES + "rel mjc:sideSites = </bot/a/s0>\nuniform int[] mjc:sideSites:indices = [5, 5, 5]",
    ],
)
def test_a_path_that_cannot_be_followed_is_named_and_warned_about(tmp_path, text):
    model, done = chain(tmp_path, tendon(text) + actuator("cord"))
    assert (model.ntendon, model.nu) == (0, 0)
    assert any("/bot/cord" in warning for warning in done.report.warnings)
    assert "MjcTendon" in {item.name for item in done.report.left_out}
