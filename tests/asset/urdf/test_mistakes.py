"""A wrong or hostile URDF gives one error message that names the mistake and its place, and no file."""

import pytest

from wheelleg_exp.asset import convert, convert_cached
from wheelleg_exp.errors import AssetError

from ..small_urdf import TETRAHEDRON, inertial, joint, link, pair, write

HEAD = '<robot name="bot">'
TEXTURE = '<material name="m"><texture filename="$(find pkg)/$(arg a).png"/></material>'


def refused(folder, text: str, name: str = "bot.urdf") -> str:
    source = folder / name
    source.write_text(text)
    with pytest.raises(AssetError) as caught:
        convert(source, folder / "out.xml")
    assert not (folder / "out.xml").exists()
    return str(caught.value)


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("", "'bot.urdf' has no link"),
        (link("a") + link("a"), "there are two links 'a'"),
        (pair() + joint("j", "b", "a"), "there are two joints 'j'"),
        (pair() + link("c"), "2 links have no parent joint: a, c"),
        (pair() + link("c") + joint("k", "c", "b"), "link 'b' is the child of two joints, 'j' and 'k'"),
        (pair() + joint("k", "b", "a"), "the joints form a cycle"),
        (link("r") + pair() + joint("k", "b", "a"), "link 'a' is not reached from the root 'r'"),
        (link("a") + joint("j", "a", "a"), "the joints form a cycle"),
        (link("a") + link("b") + joint("j", "a", "bb"), "there is no link 'bb'"),
        (pair("revolut"), "there is no joint type 'revolut'"),
        (link(""), "<link> has no 'name'"),
        ('<link name="a"/><joint name="j" type="fixed"><child link="a"/></joint>', "<joint> has no <parent>"),
        (pair("continuous", '<axis xyz="0 0 0"/>'), "the axis has no direction"),
        (pair("continuous", '<origin xyz="0 0 nan"/>'), "'xyz' is '0 0 nan'"),
        (pair("continuous", '<origin xyz="1e999 0 0"/>'), "'xyz' is '1e999 0 0'"),
        (pair("continuous", '<dynamics damping="-1"/>'), "'damping' is -1"),
        (link("a", inertial=inertial(1e-20)), "the link moves, and its mass or inertia is below 1e-15"),
        (link("a", inertial=inertial(-2)), "'value' is -2"),
        (link("a", inertial='<inertial><mass value="1_0"/></inertial>'), "'value' is '1_0'"),
        (link("a", "<collision><geometry><sphere/></geometry></collision>"), "<sphere> has no 'radius'"),
        ('<link name="world"/>', "the file contains only the world"),
        ('<xacro:include filename="x"/>' + link("a"), "the file contains unexpanded xacro"),
        (link("${prefix}a"), "the file contains unexpanded xacro"),
        (TEXTURE + link("a"), "unexpanded xacro"),
    ],
)
def test_a_mistake_is_reported_with_its_element(tmp_path, inside, message):
    told = refused(tmp_path, f"{HEAD}{inside}</robot>")
    assert message in told
    assert f"{tmp_path / 'bot.urdf'}:" in told


def test_the_line_of_a_mistake_is_right(tmp_path):
    text = f"\n\n{HEAD}\n{link('a')}{link('b')}{joint('j', 'a', 'b', 'continuous')}</robot>"
    line = text.splitlines().index('    <parent link="a"/><child link="b"/>') + 1
    assert f"bot.urdf:{line})" in refused(tmp_path, text.replace('child link="b"', 'child link="bb"'))
    broken = text.replace('child link="b"/>', 'child link="b"')
    assert f"bot.urdf:{line + 1})" in refused(tmp_path, broken)  # line of the next element


BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not valid XML"),
        ("solid part", "not valid XML"),
        ('<?xml version="1.0" encoding="of-its-own"?><robot/>', "not valid XML: unknown encoding"),
        ("<robot>", "not valid XML"),
        ("\n<!-- saved --><HTML lang='en'><br>", "bot.urdf' is a web page (HTML), not the file itself"),
        ("<mujoco/>", "is not a URDF: its outermost element is <mujoco>"),
        (f"{BOMB}<robot name='&b;'/>", "a document type (<!DOCTYPE ...>) is not allowed"),
        ('<!DOCTYPE robot SYSTEM "file:///etc/passwd"><robot/>', "a document type (<!DOCTYPE ...>) is not allowed"),
        ("<robot>" + "<link>" * 5000 + "</link>" * 5000 + "</robot>", "more than 60 levels deep"),
    ],
)
def test_a_file_that_is_not_a_urdf_is_refused(tmp_path, text, message):
    assert message in refused(tmp_path, text)


def test_formats_are_recognised_by_their_endings(tmp_path):
    assert "contains xacro macros" in refused(tmp_path, HEAD, "bot.urdf.xacro")
    assert ".usda, .usdc, .usdz, .urdf" in refused(tmp_path, HEAD, "bot.sdf")
    write(tmp_path, link("a")).rename(tmp_path / "BOT.URDF")
    assert convert(tmp_path / "BOT.URDF", tmp_path / "out.xml").report.model == "bot"


def test_a_urdf_has_no_variants(tmp_path):
    source, variants = write(tmp_path, link("a")), {"Physics": "PhysX"}
    refusal = "--variant Physics=PhysX: a URDF file has no variants"
    with pytest.raises(AssetError, match=refusal):
        convert(source, tmp_path / "out.xml", variants=variants)
    with pytest.raises(AssetError, match=refusal):
        convert_cached(source, cache_dir=tmp_path, variants=variants)


# ---------------------------------------------------------------- where the model goes
def test_an_output_among_the_meshes_of_another_is_refused(tmp_path):
    source = write(tmp_path, link("a"))
    (tmp_path / "robot.xml").write_text("<mujoco/>")
    with pytest.raises(AssetError, match="contains the meshes of another MJCF"):
        convert(source, tmp_path / "robot_meshes" / "other.xml")


def test_an_interrupted_swap_leaves_the_older_model_with_its_meshes(tmp_path, monkeypatch):
    part = tmp_path / "part.obj"
    part.write_text(TETRAHEDRON)
    visual = '<visual><geometry><mesh filename="part.obj"/></geometry></visual>'
    output = convert(write(tmp_path, link("a", visual)), tmp_path / "out.xml").output
    meshes = tmp_path / "out_meshes" / "part_visual.obj"
    before = (output.read_bytes(), meshes.read_bytes())
    part.write_text(part.read_text().replace("v 0 0 1", "v 0 0 9"))
    whole = type(output).replace

    def interrupted(path, target):
        if target == output:
            raise KeyboardInterrupt
        return whole(path, target)

    monkeypatch.setattr(type(output), "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        convert(tmp_path / "bot.urdf", output)
    assert (output.read_bytes(), meshes.read_bytes()) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bot.urdf", "out.xml", "out_meshes", "part.obj"]


@pytest.mark.parametrize(
    ("inside", "warned"),
    [
        ('<limit lower="-90" upper="90" effort="1" velocity="1"/>', ["limits -90 to 90 are 180 rad apart"]),
        ('<limit lower="0" upper="180" effort="1" velocity="1"/>', ["limits 0 to 180 are 180 rad apart"]),
        ('<origin rpy="0 90 0"/><limit lower="-1" upper="1"/>', ["rpy '0 90 0' is more than a turn"]),
        ('<origin rpy="0 1.57 0"/><limit lower="-6.3" upper="6.3"/>', []),
    ],
)
def test_degrees_in_place_of_radians_are_named(inside, warned, tmp_path):
    (tmp_path / "bot.urdf").write_text(f"{HEAD}{pair('revolute', inside)}</robot>")
    report = convert(tmp_path / "bot.urdf", tmp_path / "out.xml").report
    found = [text for text in report.warnings if text.endswith("URDF has radians, not degrees")]
    assert [text.split(": ")[1] for text in found] == warned
