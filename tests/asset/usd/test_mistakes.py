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


def test_a_file_that_is_not_there(tmp_path):
    error = told(tmp_path / "absent.usda", tmp_path / "out.xml")
    assert "there is no file" in str(error)
    assert "absent.usda" in str(error)


def test_a_file_that_is_no_usd(tmp_path):
    path = tmp_path / "robot.stl"
    path.write_text("solid robot")
    assert ".usda" in told(path, tmp_path / "out.xml").expected


@pytest.mark.parametrize("suffix", ["usd", "usda", "usdc"])
def test_nonsense_in_a_usd_file_leaves_no_output(tmp_path, suffix):
    path = tmp_path / f"robot.{suffix}"
    path.write_text("not a stage")
    assert "cannot be read" in str(told(path, tmp_path / "out" / "robot.xml"))
    assert leftovers(tmp_path) == [path.name]


def test_a_file_that_git_lfs_has_not_fetched_is_told(tmp_path):
    path = tmp_path / "robot.usd"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    assert "git lfs pull" in str(told(path, tmp_path / "out.xml"))


def test_a_syntax_error_is_named_with_its_line(tmp_path):
    path = write(tmp_path, link("a"))
    path.write_text(path.read_text() + "def Xform {\n")
    lines = len(path.read_text().splitlines())
    assert told(path, tmp_path / "out.xml").where.endswith(f"bot.usda:{lines}")


def test_a_stage_without_bodies_has_no_articulation(tmp_path):
    path = write(tmp_path, 'def Xform "thing"\n{\n}\n')
    error = told(path, tmp_path / "out.xml")
    assert "'bot.usda' has no articulation" in str(error)
    assert leftovers(tmp_path) == ["bot.usda"]


def test_a_missing_layer_is_named_when_the_bodies_are_missing(tmp_path):
    path = write(tmp_path, 'def Xform "thing" (references = @parts/arm.usda@)\n{\n}\n')
    assert "parts/arm.usda" in str(told(path, tmp_path / "out.xml"))


def test_an_unknown_variant_set_and_name(tmp_path):
    variants = """def Xform "bot" (
    variants = { string Physics = "PhysX" }
    prepend variantSets = "Physics"
)
{
    variantSet "Physics" = { "PhysX" {} "None" {} }
"""
    path = write(tmp_path, link("a"))
    path.write_text(path.read_text().replace('def Xform "bot" \n{\n', variants))
    assert told(path, tmp_path / "out.xml", variants={"Phisics": "None"}).nearest == "Physics"
    assert told(path, tmp_path / "out.xml", variants={"Physics": "Physx"}).nearest == "PhysX"


@pytest.mark.parametrize("place", ["bot", "bot/hand"])
def test_a_variant_set_without_a_selection_lists_its_choices(tmp_path, place):
    holder = """def Xform "{}" (
    prepend variantSets = "Grip"
)
{{
    variantSet "Grip" = {{ "soft" {{}} "hard" {{}} }}
"""
    path = write(tmp_path, link("a"))
    if place == "bot":
        path.write_text(path.read_text().replace('def Xform "bot" \n{\n', holder.format("bot")))
    else:
        path = write(tmp_path, link("a") + holder.format("hand") + "}")
    warnings = convert(path, tmp_path / "out.xml").report.warnings
    assert f"/{place}: no variant of 'Grip' is selected; --variant Grip=NAME takes one of hard, soft" in warnings
    chosen = convert(path, tmp_path / "out.xml", variants={"Grip": "soft"}).report
    assert not any("Grip" in warning for warning in chosen.warnings)


def test_what_mujoco_refuses_is_told_and_leaves_no_output(tmp_path, monkeypatch):
    def refuse(path: str) -> None:
        raise ValueError("Error: no such thing")

    monkeypatch.setattr("mujoco.MjModel.from_xml_path", refuse)
    path = write(tmp_path, link("a"))
    assert "MuJoCo cannot build a model" in str(told(path, tmp_path / "out.xml"))
    assert leftovers(tmp_path) == ["bot.usda"]


def test_a_failed_conversion_keeps_the_older_output(tmp_path):
    output = tmp_path / "bot.xml"
    convert(write(tmp_path, link("a")), output)
    before = output.read_bytes()
    told(write(tmp_path, 'def Xform "thing"\n{\n}\n'), output)
    assert output.read_bytes() == before


def mesh(points: str, counts: str, indices: str) -> str:
    return f"""def Mesh "m" (prepend apiSchemas = ["PhysicsCollisionAPI"])
        {{
            point3f[] points = {points}
            int[] faceVertexCounts = {counts}
            int[] faceVertexIndices = {indices}
        }}"""


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
def test_a_shape_that_nothing_can_be_made_of_is_named_and_no_end(tmp_path, inside):
    done = convert(write(tmp_path, link("a", inside=inside)), tmp_path / "out.xml")
    assert done.description.colliders == ()
    assert any("/bot/a/m" in warning for warning in done.report.warnings)
    assert any("/bot/a/m" in item.values for item in done.report.left_out)
