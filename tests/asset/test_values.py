"""The values in the report's JSON equal those of the MuJoCo model of the MJCF."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from .small_urdf import BOX, inertial, joint, link, made


@pytest.fixture(scope="module")
def stock(conversion):
    return mujoco.MjModel.from_xml_path(str(conversion.output)), json.loads(conversion.report.to_json())


def test_bodies_weigh_what_the_model_weighs(stock):
    model, report = stock
    for name, body in report["values"]["bodies"].items():
        item = model.body(name)
        assert item.mass[0] == pytest.approx(body["mass"])
        np.testing.assert_allclose(item.ipos, body["center_of_mass"], atol=1e-12)
        np.testing.assert_allclose(sorted(item.inertia), sorted(body["inertia"][:3]), rtol=1e-9)
        np.testing.assert_allclose(item.pos, body["position"], atol=1e-12)
        assert model.body(item.parentid[0]).name == (body["parent"] or "world")


def test_tensors_are_turned_into_the_bodys_axes(tmp_path):
    own = inertial(2, rpy="0 0 0.5", tensor="0.2 0.3 0.4 0 0 0")
    _, done = made(tmp_path, link("a", BOX, own))
    c, s = np.cos(0.5), np.sin(0.5)
    expected = [0.2 * c * c + 0.3 * s * s, 0.2 * s * s + 0.3 * c * c, 0.4, (0.2 - 0.3) * c * s, 0, 0]
    np.testing.assert_allclose(done.report.values["bodies"]["a"]["inertia"], expected, atol=1e-9)


def test_joints_have_the_kinds_ranges_and_gains_of_the_model_and_the_files_own(stock):
    model, report = stock
    joints = report["values"]["joints"]
    assert list(joints) == report["dof_order"]["mujoco"]
    for name, item in joints.items():
        found, motor = model.joint(name), model.actuator(name)
        assert (item["kind"], item["body"]) == ("hinge", model.body(found.bodyid[0]).name)
        assert (item["range"] is not None) == bool(model.jnt_limited[found.id])
        np.testing.assert_array_equal(found.axis, item["axis"])
        assert item["armature"] == model.dof_armature[found.dofadr[0]]
        assert item["drive"]["kp"] == pytest.approx(-motor.biasprm[1])
        assert (item["drive"]["kv"], item["effort"]) == (pytest.approx(-motor.biasprm[2]), motor.forcerange[1])
    authored = report["authored"][joints["l01"]["path"]]
    assert np.radians(authored["physics:upperLimit"]) == pytest.approx(joints["l01"]["range"][1])
    assert np.degrees(authored["drive:angular:physics:stiffness"]) == pytest.approx(joints["l01"]["drive"]["kp"])


def test_colliders_are_those_of_the_model(stock):
    model, report = stock
    colliders = report["values"]["colliders"]
    solid = [g for g in range(model.ngeom) if model.geom_contype[g]]
    assert {model.geom(g).name for g in solid} == set(colliders)
    for g in solid:
        item = colliders[model.geom(g).name]
        assert model.body(model.geom_bodyid[g]).name == item["body"]
        np.testing.assert_array_equal(model.geom_size[g][: len(item["size"])], item["size"])
        assert model.geom_friction[g, 0] == item["friction"]


def test_a_joint_of_a_urdf_has_what_is_written(tmp_path):
    limit = '<limit lower="-1" upper="2" effort="30" velocity="8"/>'
    done = made(tmp_path, link("a", BOX) + link("b", BOX) + joint("j", "a", "b", "revolute", limit))[1]
    item = done.report.values["joints"]["j"]
    assert (item["range"], item["effort"], item["velocity"], item["drive"]) == ([-1, 2], 30, 8, None)
    assert done.report.authored == {item["path"]: {"lower": -1, "upper": 2, "effort": 30, "velocity": 8}}


def test_an_infinite_limit_is_json_as_others_read_it(tmp_path):
    limit = '<limit lower="-inf" upper="inf"/>'
    _, done = made(tmp_path, link("a") + link("b") + joint("j", "a", "b", "revolute", limit))
    json.loads(done.report.to_json(), parse_constant=lambda word: pytest.fail(word))


def test_a_mesh_has_its_box(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    shape = '<collision><geometry><mesh filename="m.obj"/></geometry></collision>'
    _, done = made(tmp_path, link("a", shape))
    assert done.report.values["meshes"] == {"m": {"vertices": 4, "faces": 4, "low": [0, 0, 0], "high": [1, 2, 3]}}
    assert Path(done.output).exists()
