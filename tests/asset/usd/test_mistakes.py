"""A wrong USD file gives an error message that names the mistake, and no output file."""

from __future__ import annotations

import pytest

from wheelleg_exp.asset import convert
from wheelleg_exp.errors import AssetError

from ..small_usd import link, write


def told(path, output, **options) -> AssetError:
    with pytest.raises(AssetError) as caught:
        convert(path, output, **options)
    return caught.value


def leftovers(folder):
    return sorted(p.name for p in folder.rglob("*"))


BODILESS = '#usda 1.0\n(\n defaultPrim = "bot"\n)\ndef Xform "bot" {{\ndef Xform "thing"{}\n{{\n}}\n}}\n'


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("robot.stl", "solid robot", "; expected .usd, .usda"),
        ("robot.usda", "", "is empty"),
        ("robot.usda", "not a stage", "cannot be read"),
        ("robot.usdc", "not a stage", "cannot be read"),
        ("robot.usd", "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git lfs pull"),
        ("robot.usda", "<!DOCTYPE html>\n<html></html>", "robot.usda' is a web page (HTML)"),
        ("bot.usda", BODILESS.format(""), "'bot.usda' has no articulation"),
        ("bot.usda", BODILESS.format(" (references = @parts/arm.usda@)"), "parts/arm.usda"),
    ],
)
def test_a_file_without_a_robot_is_refused_and_leaves_no_output(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    assert words in str(told(tmp_path / name, tmp_path / "out" / "robot.xml"))
    assert leftovers(tmp_path) == [name]


def test_a_syntax_error_is_named_with_its_line(tmp_path):
    path = write(tmp_path, link("a"))
    path.write_text(path.read_text() + "def Xform {\n")
    lines = len(path.read_text().splitlines())
    assert told(path, tmp_path / "out.xml").where.endswith(f"bot.usda:{lines}")


def test_an_unknown_variant_set_and_name(tmp_path):
    variants = 'def Xform "bot" (\n variants = { string Physics = "PhysX" }\n prepend variantSets = "Physics"\n)\n{\n'
    variants += 'variantSet "Physics" = { "PhysX" {} "None" {} }\n'
    path = write(tmp_path, link("a"))
    path.write_text(path.read_text().replace('def Xform "bot" \n{\n', variants))
    assert told(path, tmp_path / "out.xml", variants={"Phisics": "None"}).nearest == "Physics"
    assert told(path, tmp_path / "out.xml", variants={"Physics": "Physx"}).nearest == "PhysX"


@pytest.mark.parametrize("place", ["bot", "bot/hand"])
def test_a_variant_set_without_a_selection_lists_its_choices(tmp_path, place):
    holder = 'def Xform "{}" (prepend variantSets = "Grip")\n{{\nvariantSet "Grip" = {{ "soft" {{}} "hard" {{}} }}\n'
    path = write(tmp_path, link("a"))
    if place == "bot":
        path.write_text(path.read_text().replace('def Xform "bot" \n{\n', holder.format("bot")))
    else:
        path = write(tmp_path, link("a") + holder.format("hand") + "}")
    warnings = convert(path, tmp_path / "out.xml").report.warnings
    assert f"/{place}: no variant of 'Grip' is selected; --variant Grip=NAME takes one of hard, soft" in warnings
    chosen = convert(path, tmp_path / "out.xml", variants={"Grip": "soft"}).report
    assert not any("Grip" in warning for warning in chosen.warnings)


def test_a_model_that_mujoco_refuses_is_an_error_and_leaves_no_output(tmp_path, monkeypatch):
    def refuse(path: str) -> None:
        raise ValueError("Error: no such thing")

    monkeypatch.setattr("mujoco.MjModel.from_xml_path", refuse)
    assert "MuJoCo cannot build a model" in str(told(write(tmp_path, link("a")), tmp_path / "out.xml"))
    assert leftovers(tmp_path) == ["bot.usda"]


def test_a_failed_conversion_does_not_change_the_older_output(tmp_path):
    output = tmp_path / "bot.xml"
    convert(write(tmp_path, link("a")), output)
    before = output.read_bytes()
    told(write(tmp_path, 'def Xform "thing"\n{\n}\n'), output)
    assert output.read_bytes() == before


def mesh(points: str, counts: str, indices: str) -> str:
    text = f"point3f[] points = {points}\nint[] faceVertexCounts = {counts}\nint[] faceVertexIndices = {indices}"
    return f'def Mesh "m" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{{\n{text}\n}}'


@pytest.mark.parametrize(
    "inside",
    [
        mesh("[]", "[]", "[]"),
        mesh("[(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]", "[4]", "[0, 1, 2, 3]"),
        mesh("[(0, 0, 0), (1, 0, 0), (0, 1, 0)]", "[3]", "[0, 1, 7]"),
        'def Sphere "m" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n double radius = 0\n}',
        'def NurbsPatch "m" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}',
    ],
    ids=["empty", "a line", "a bad index", "no size", "not supported"],
)
def test_an_unusable_shape_is_reported_and_does_not_stop_the_import(tmp_path, inside):
    done = convert(write(tmp_path, link("a", inside=inside)), tmp_path / "out.xml")
    assert done.description.colliders == ()
    assert any("/bot/a/m" in warning for warning in done.report.warnings)
    assert any("/bot/a/m" in item.values for item in done.report.left_out)
