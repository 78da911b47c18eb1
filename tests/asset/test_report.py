"""The report: complete for the stock robot, one JSON document, the same bytes every time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pxr import Usd

from wheelleg_exp.asset import Conversion, Report, convert
from wheelleg_exp.paths import find_asset

from .small_usd import converted, cube_inside, link, two_links, write

# What stands for physics in a USD file, written here anew and not taken from the converter.
PHYSICS = ("physics:", "physx", "drive:", "state:", "limit:", "newton:", "mjc:")


@pytest.fixture(scope="module")
def source() -> Path:
    return find_asset("wheelleg/wheelleg.usda")


@pytest.fixture(scope="module")
def conversion(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Conversion:
    return convert(source, tmp_path_factory.mktemp("robot") / "wheelleg.xml")


def test_every_physics_property_of_the_robot_is_mapped_or_named(source, conversion):
    report = conversion.report
    mapped = {(item.path, item.name) for item in report.mapped}
    left = {(path, item.name) for item in report.left_out for path in item.values}
    stage = Usd.Stage.Open(str(source))
    authored = {
        (str(prim.GetPath()), prop.GetName())
        for prim in Usd.PrimRange(stage.GetDefaultPrim(), Usd.TraverseInstanceProxies())
        for prop in prim.GetAuthoredProperties()
        if prop.GetName().startswith(PHYSICS)
    }
    assert len(authored) > 100
    assert authored - mapped - left == set()
    assert not mapped & left


def test_every_shape_and_joint_of_the_robot_is_mapped(source, conversion):
    mapped = {item.path for item in conversion.report.mapped}
    stage = Usd.Stage.Open(str(source))
    kinds = {"Cube", "Capsule", "Cylinder", "Sphere", "PhysicsRevoluteJoint", "IsaacImuSensor"}
    for prim in Usd.PrimRange(stage.GetDefaultPrim(), Usd.TraverseInstanceProxies()):
        if prim.GetTypeName() in kinds:
            assert str(prim.GetPath()) in mapped


def test_what_is_left_out_says_why(conversion):
    left = {item.name: item for item in conversion.report.left_out}
    assert set(left) == {
        "physxArticulation:solverPositionIterationCount",
        "physxArticulation:solverVelocityIterationCount",
        "physxJoint:maxJointVelocity",
        "physics:staticFriction",
        "physics:restitution",
    }
    assert all(item.reason for item in left.values())
    assert left["physxJoint:maxJointVelocity"].values["/wheelleg/joints/l03"] == "45 rad/s"


@pytest.mark.parametrize(
    "text",
    [
        "float physxJoint:jointFriction = 0.1",
        "float physxLimit:angular:stiffness = 3",
        "float mjc:springref = 10",
        "float newton:nobody:knows = 1",
        "float physics:nobody:knows = 1",
    ],
)
def test_an_unread_physics_attribute_is_named_with_its_value(tmp_path, text):
    _, done = two_links(tmp_path, text)
    name, value = text.split()[1], text.split()[-1]
    (entry,) = [item for item in done.report.left_out if item.name == name]
    assert float(entry.values["/bot/j"]) == float(value)


def test_a_scene_beside_the_robot_is_read_and_its_rest_is_named(tmp_path):
    scene = 'def PhysicsScene "scene"\n{\n    uint physxScene:timeStepsPerSecond = 120\n}'
    _, done = converted(write(tmp_path, link("a"), outside=scene))
    (entry,) = [item for item in done.report.left_out if item.name == "physxScene:timeStepsPerSecond"]
    assert entry.values == {"/scene": "120"}


def test_kinds_of_prims_without_a_place_are_named(tmp_path):
    body = link("a") + 'def PhysicsDistanceJoint "rope"\n{\n rel physics:body0 = </bot/a>\n}\n'
    body += 'def Camera "eye"\n{\n}\ndef SphereLight "lamp"\n{\n}\n'
    _, done = converted(write(tmp_path, body))
    assert {"PhysicsDistanceJoint", "Camera", "SphereLight"} <= {item.name for item in done.report.left_out}
    assert any("/bot/rope" in warning for warning in done.report.warnings)


def test_a_mesh_that_is_no_hull_is_warned_about(tmp_path):
    _, done = converted(write(tmp_path, link("a", inside=cube_inside("convexDecomposition"))))
    assert any("convexDecomposition" in warning for warning in done.report.warnings)


def test_a_missing_texture_layer_is_no_end(tmp_path):
    body = link("a") + 'def Xform "extra" (references = @textures/wood.usda@)\n{\n}\n'
    _, done = converted(write(tmp_path, body))
    assert done.report.unresolved == ("textures/wood.usda",)


def test_totals_are_those_of_the_model(conversion):
    totals = conversion.report.totals
    assert totals["bodies"] == 7
    assert totals["dofs"] == 6
    assert totals["colliders"] == 7
    assert totals["actuators"] == 6
    assert totals["mass"] == pytest.approx(0.5)


def test_is_one_json_document_that_can_be_read_back(conversion):
    text = conversion.report.to_json()
    json.loads(text)
    assert Report.from_json(text) == conversion.report


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"version": 99}', '{"version": 1}'])
def test_what_is_no_report_is_refused(text):
    with pytest.raises(ValueError, match=r".*"):
        Report.from_json(text)


def test_two_conversions_are_equal_to_the_byte(source, tmp_path):
    first = convert(source, tmp_path / "a" / "robot.xml")
    second = convert(source, tmp_path / "b" / "robot.xml")
    assert first.output.read_bytes() == second.output.read_bytes()
    assert first.report.to_json() == second.report.to_json()


def test_assumptions_stand_in_the_models_head(conversion):
    head = conversion.output.read_text().split("<mujoco")[0]
    for item in conversion.report.assumptions:
        assert item.rule in head
