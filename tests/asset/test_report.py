"""The conversion report is complete for the stock robot, and equal conversions give equal JSON."""

from __future__ import annotations

import json
import math

import mujoco
import pytest
from pxr import Usd

from wheelleg_exp.asset import Report, convert, convert_robot
from wheelleg_exp.asset.mjcf import compile_mjcf

from .small_usd import applied, converted, cube_inside, link, two_links, warned, write

# Prefixes of physics attributes in USD; the test does not use the converter's own list.
PHYSICS = ("physics:", "physx", "drive:", "state:", "limit:", "newton:", "mjc:")


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
    assert (authored - mapped - left, mapped & left) == (set(), set())
    kinds = {"Cube", "Capsule", "Cylinder", "Sphere", "PhysicsRevoluteJoint", "IsaacImuSensor"}
    prims = Usd.PrimRange(stage.GetDefaultPrim(), Usd.TraverseInstanceProxies())
    assert {str(prim.GetPath()) for prim in prims if prim.GetTypeName() in kinds} <= {path for path, _ in mapped}


def test_omitted_attributes_have_a_reason(conversion):
    left = {item.name: item for item in conversion.report.left_out}
    assert set(left) == {
        "physxArticulation:solverPositionIterationCount",
        "physxArticulation:solverVelocityIterationCount",
        "physxJoint:maxJointVelocity",
        "physxJointAxis:angular:maxJointVelocity",
        "physics:staticFriction",
        "physics:restitution",
    }
    assert all(item.reason for item in left.values())
    for schema in ("physxJoint", "physxJointAxis:angular"):
        assert left[f"{schema}:maxJointVelocity"].values["/wheelleg/joints/l03"] == "45 rad/s"


UNREAD = ["physxJoint:jointFriction", "physxLimit:angular:stiffness", "newton:limitStiffness", "newton:limitDamping"]
UNREAD += [f"{prefix}:nobody:knows" for prefix in ("mjc", "newton", "physics")]


@pytest.mark.parametrize("name", UNREAD)
def test_an_unread_physics_attribute_is_named_with_its_value(tmp_path, name):
    model, done = two_links(tmp_path, f"float {name} = 0.1\n        rel physics:velocity = </bot>")
    left = {item.name: item.values for item in done.report.left_out}
    assert (float(left[name]["/bot/j"]), model.dof_frictionloss[6]) == (0.1, 0)
    assert "/bot/j" in left["physics:velocity"]  # a relationship with the name of an attribute


def test_a_scene_next_to_the_robot_is_read_and_its_remaining_parts_are_named(tmp_path):
    scene = 'def PhysicsScene "scene"\n{\n    uint physxScene:timeStepsPerSecond = 120\n}'
    _, done = converted(write(tmp_path, link("a"), outside=scene))
    (entry,) = [item for item in done.report.left_out if item.name == "physxScene:timeStepsPerSecond"]
    assert entry.values == {"/scene": "120"}


MOVING = ["ForceAPI", "SurfaceVelocityAPI", "TendonAxisAPI:inst0", "DeformableBodyAPI", "ParticleAPI"]


@pytest.mark.parametrize("schema", [f"Physx{name}" for name in MOVING])
def test_a_schema_that_moves_the_robot_and_is_not_read_is_warned_about(tmp_path, schema):
    _, done = converted(write(tmp_path, link("a", apis=schema)))
    assert any(item.name == schema and "/bot/a" in item.values for item in done.report.left_out)
    assert any(text.startswith("/bot/a: ") and schema in text for text in done.report.warnings)


@pytest.mark.parametrize("schema", ["PhysxNobodyKnowsAPI", "NobodyKnowsAPI"])
def test_only_an_unknown_schema_of_physics_is_named(tmp_path, schema):
    _, done = converted(write(tmp_path, link("a", apis=schema)))
    assert ([item.name for item in done.report.left_out] == [schema]) is schema.startswith("Physx")


@pytest.mark.parametrize("kind", ["PhysxPhysicsGearJoint", "PhysxParticleSystem", "OmniGraph", "Camera", "SphereLight"])
def test_a_kind_of_prim_without_a_place_is_named(tmp_path, kind):
    _, done = converted(write(tmp_path, link("a", inside=f'def {kind} "thing"\n{{\n}}\n')))
    (entry,) = [item for item in done.report.left_out if item.name == kind]
    assert entry.values == {"/bot/a/thing": ""}
    assert bool(warned(done)) is kind.startswith("Physx")


def test_physics_outside_the_default_prim_is_named_but_not_what_the_robot_is_made_of(tmp_path):
    shape = 'def Sphere "s" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}\n'
    outside = f'def Xform "ground"\n{{\n{shape}}}\ndef Xform "colliders"\n{{\n{shape}}}\n'
    inside = 'def Xform "c" (\ninstanceable = true\nreferences = </colliders>\n)\n{\n}\n'
    _, done = converted(write(tmp_path, link("a", inside=inside), outside=outside))
    assert [item.values for item in done.report.left_out] == [{"/ground": "colliders: 1"}]
    assert len(done.description.colliders) == 1


def test_a_material_outside_the_default_prim_is_accounted_for(tmp_path):
    material = f'def Material "rubber" {applied("PhysicsMaterialAPI")} {{ float physics:dynamicFriction = 0.7\n'
    material += "float physxMaterial:compliantContactStiffness = 5\n}\n"
    shape = f'def Sphere "s" {applied("PhysicsCollisionAPI MaterialBindingAPI")}\n'
    shape += "{\nrel material:binding:physics = </rubber>\n}\n"
    model, done = converted(write(tmp_path, link("a", inside=shape), outside=material))
    assert model.geom_friction[0, 0] == 0.7
    assert "physxMaterial:compliantContactStiffness" in {item.name for item in done.report.left_out}
    assert ("/bot/a/s", "material:binding:physics") in {(item.path, item.name) for item in done.report.mapped}


def test_a_missing_texture_or_library_is_reported_and_does_not_stop_the_import(tmp_path):
    assets = "asset inputs:diffuse_texture = @gone.png@; asset info:mdl:sourceAsset = @OmniPBR.mdl@"
    _, done = converted(write(tmp_path, link("a") + f'def Material "m" {{ def Shader "s" {{ {assets}; }}\n}}\n'))
    left = {item.name: item for item in done.report.left_out}
    assert set(left) == {"inputs:diffuse_texture", "info:mdl:sourceAsset"}
    assert left["inputs:diffuse_texture"].values == {"/bot/m/s": "gone.png"}
    assert "missing" in left["inputs:diffuse_texture"].reason
    assert warned(done) == ()


def test_a_mesh_of_several_materials_takes_that_of_most_faces(tmp_path):
    def material(name: str, color: str) -> str:
        return f'def Material "{name}" {{ def Shader "s" {{ color3f inputs:diffuseColor = {color}; }}\n}}\n'

    def subset(name: str, indices: str) -> str:
        text = f"int[] indices = {indices}; rel material:binding = </bot/{name}>"
        return f'def GeomSubset "{name}" {applied("MaterialBindingAPI")} {{ {text}; }}\n'

    block = cube_inside("none").rstrip()[:-1] + subset("red", "[0]") + subset("blue", "[1, 2, 3, 4, 5]") + "}\n"
    body = link("a", inside=block) + material("red", "(1, 0, 0)") + material("blue", "(0, 0, 1)")
    _, done = converted(write(tmp_path, body))
    assert [item.rgba for item in done.description.materials] == [(0, 0, 1, 1)]


EMPTY = 'def Xform "collisions" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}\n'


@pytest.mark.parametrize(
    ("inside", "told"), [(EMPTY, "/bot/a/collisions"), (cube_inside("convexDecomposition"), "convexDecomposition")]
)
def test_a_collider_without_a_hull_is_warned_about(tmp_path, inside, told):
    _, done = converted(write(tmp_path, link("a", inside=inside)))
    assert any(told in text for text in done.report.warnings)


def test_is_one_json_document_that_can_be_read_back_and_its_assumptions_are_in_the_models_head(conversion):
    report = conversion.report
    assert json.loads(report.to_json())["totals"]["mass"] == pytest.approx(0.5)
    assert Report.from_json(report.to_json()) == report
    assert [report.totals[key] for key in ("bodies", "dofs", "colliders", "actuators")] == [7, 6, 7, 6]
    head = conversion.output.read_text().split("<mujoco")[0]
    assert all(item.rule in head for item in report.assumptions)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"version": 99}', '{"version": 1}'])
def test_texts_that_are_not_reports_are_refused(text):
    with pytest.raises(ValueError, match=r".*"):
        Report.from_json(text)


def test_two_conversions_are_equal_to_the_byte(source, tmp_path):
    first = convert(source, tmp_path / "a" / "robot.xml")
    second = convert(source, tmp_path / "b" / "robot.xml")
    assert first.output.read_bytes() == second.output.read_bytes()
    assert first.report.to_json() == second.report.to_json()


def test_a_warning_of_mujoco_is_in_the_report_and_in_no_log_file(tmp_path, monkeypatch):
    def odd(path, source):
        falling = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
        model = mujoco.MjModel.from_xml_string(falling)
        data = mujoco.MjData(model)
        data.qpos[0] = math.nan
        mujoco.mj_step(model, data)
        return compile_mjcf.load(path, source)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(convert_robot, "load", odd)
    done = convert_robot.convert(write(tmp_path, link("a")), tmp_path / "out.xml")
    (warning,) = [text for text in done.report.warnings if text.startswith("MuJoCo: ")]
    assert "QPOS" in warning
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    assert mujoco.get_mju_user_warning() is None
