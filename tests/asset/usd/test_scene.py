"""Gravity in all USD forms, files with several physics scenes, and friction of bound physics materials."""

import numpy as np
import pytest

from ..small_usd import MASS, SI, applied, converted, link, write

CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    upAxis = "Y"'
CUBE = f'def Cube "cube" {applied("PhysicsCollisionAPI MaterialBindingAPI")} {{{{ double size = 0.2\n{{}}\n}}}}\n'


def scene(text: str, name: str = "scene", apis: str = "") -> str:
    return f'def PhysicsScene "{name}" {applied(apis)}\n{{\n    {text}\n}}\n'


def material(name: str, friction: float, more: str = "") -> str:
    text = f"float physics:dynamicFriction = {friction}\n{more}"
    return f'def Material "{name}" (prepend apiSchemas = ["PhysicsMaterialAPI"]) {{\n{text}\n}}\n'


# ------------------------------------------------------------------ gravity
@pytest.mark.parametrize(
    ("text", "header", "expected"),
    [
        ("", SI, [0, 0, -9.81]),
        ("float physics:gravityMagnitude = 3.7", SI, [0, 0, -3.7]),
        ("float physics:gravityMagnitude = 0", SI, [0, 0, 0]),
        ("float physics:gravityMagnitude = -1", SI, [0, 0, -9.81]),
        ("float physics:gravityMagnitude = -inf", SI, [0, 0, -9.81]),
        ("vector3f physics:gravityDirection = (0, 0, 0)", SI, [0, 0, -9.81]),
        ("vector3f physics:gravityDirection = (3, 0, 0)\n float physics:gravityMagnitude = 2", SI, [2, 0, 0]),
        ("float physics:gravityMagnitude = 981", CM, [0, 0, -9.81]),
        ("vector3f physics:gravityDirection = (0, -1, 0)\n float physics:gravityMagnitude = 981", CM, [0, 0, -9.81]),
        ("vector3f physics:gravityDirection = (0, 0, 1)\n float physics:gravityMagnitude = 100", CM, [0, -1, 0]),
        ("vector3f physics:gravityDirection = (0, 0, 0)", CM, [0, 0, -9.81]),
        ("bool newton:gravityEnabled = 0", SI, [0, 0, 0]),
    ],
)
def test_gravity(tmp_path, text, header, expected):
    model, _ = converted(write(tmp_path, link("a"), header=header, outside=scene(text)))
    np.testing.assert_allclose(model.opt.gravity, expected, atol=1e-6)


def test_of_several_scenes_that_of_the_body_or_the_first_is_read_and_the_others_are_named(tmp_path):
    scenes = scene("float physics:gravityMagnitude = 1", "one") + scene("float physics:gravityMagnitude = 2", "two")
    model, done = converted(write(tmp_path, link("a"), outside=scenes))
    assert model.opt.gravity[2] == pytest.approx(-1)
    assert any("/two" in item.values for item in done.report.left_out)
    body = link("a", mass=MASS + "\n rel physics:simulationOwner = </two>")
    assert converted(write(tmp_path, body, outside=scenes))[0].opt.gravity[2] == pytest.approx(-2)


def test_a_body_without_gravity_is_carried(tmp_path):
    carried = link("a", mass=MASS + "\n bool physxRigidBody:disableGravity = 1")
    model, _ = converted(write(tmp_path, carried + link("b")))
    np.testing.assert_allclose(model.body_gravcomp, [0, 1, 0])


# ------------------------------------------------------------------ friction
def friction(folder, *, on_cube="", on_body="", on_root="", outside="", root_apis=""):
    body = link("a", mass=f"{MASS}\n{on_body}", apis="MaterialBindingAPI", inside=CUBE.format(on_cube))
    model, done = converted(write(folder, f"{on_root}\n{body}", outside=outside, root_apis=root_apis))
    return model.geom("a_cube").friction[0], done


BIND = "rel material:binding{purpose} = </{name}>"


@pytest.mark.parametrize("purpose", ["", ":physics"])
@pytest.mark.parametrize("where", ["on_cube", "on_body", "on_root"])
def test_a_material_is_bound_to_the_shape_or_to_what_is_above_it(tmp_path, purpose, where):
    options = {where: BIND.format(purpose=purpose, name="rubber"), "root_apis": "MaterialBindingAPI"}
    value, done = friction(tmp_path, outside=material("rubber", 0.7), **options)
    assert value == pytest.approx(0.7)
    path = {"on_cube": "/bot/a/cube", "on_body": "/bot/a", "on_root": "/bot"}[where]
    assert (path, f"material:binding{purpose}") in {(item.path, item.name) for item in done.report.mapped}


def test_a_material_for_physics_wins_over_one_for_all_purposes(tmp_path):
    both = BIND.format(purpose="", name="paint") + "\n" + BIND.format(purpose=":physics", name="rubber")
    value, _ = friction(tmp_path, on_cube=both, outside=material("rubber", 0.7) + material("paint", 0.1))
    assert value == pytest.approx(0.7)


def test_a_material_may_be_bound_through_a_collection(tmp_path):
    bound = (
        'uniform token collection:soft:expansionRule = "expandPrims"\n rel collection:soft:includes = </bot/a/cube>\n'
    )
    bound += "rel material:binding:collection:physics:soft = [</bot.collection:soft>, </rubber>]"
    apis = "MaterialBindingAPI CollectionAPI:soft"
    value, _ = friction(tmp_path, on_root=bound, outside=material("rubber", 0.7), root_apis=apis)
    assert value == pytest.approx(0.7)


def test_without_a_material_friction_is_the_scenes_else_physxs(tmp_path):
    assert friction(tmp_path)[0] == pytest.approx(0.5)
    bound = scene(BIND.format(purpose=":physics", name="rubber"), apis="MaterialBindingAPI")
    assert friction(tmp_path, outside=bound + material("rubber", 0.7))[0] == pytest.approx(0.7)


@pytest.mark.parametrize(("mode", "said"), [("average", True), ("min", True), ("multiply", True), ("max", False)])
def test_how_frictions_combine_is_reported_where_mujoco_differs(tmp_path, mode, said):
    rubber = material("rubber", 0.7, f'uniform token physxMaterial:frictionCombineMode = "{mode}"')
    _, done = friction(tmp_path, on_cube=BIND.format(purpose=":physics", name="rubber"), outside=rubber)
    assert any(f"'{mode}'" in item.rule for item in done.report.assumptions) is said


# ------------------------------------------------------------------ colours and names
@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ("color3f[] primvars:displayColor = [(0.25, 0.5, 0.75)]", [0.25, 0.5, 0.75, 1]),
        ("float[] primvars:displayColor = [0.25]", None),
        ("double primvars:displayColor = 3", None),
    ],
)
def test_a_display_color_colours_and_a_value_of_another_type_does_not(tmp_path, color, expected):
    model, _ = converted(write(tmp_path, link("a", inside=f'def Sphere "ball" {{ double radius = 0.1; {color}; }}\n')))
    grey = [0.5, 0.5, 0.5, 1]
    np.testing.assert_allclose(model.geom("a_ball_visual").rgba, expected or grey)


def test_without_a_default_prim_the_model_is_called_after_the_file(tmp_path):
    _, done = converted(write(tmp_path, link("a"), header='metersPerUnit = 1\n    upAxis = "Z"'))
    assert done.report.model == "bot"
