"""The rules of reading URDF give the numbers of hand-computed cases."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from wheelleg_exp.asset import convert, convert_cached, source_digest
from wheelleg_exp.cli.main import main

from ..small_urdf import (
    BOX,
    TETRAHEDRON,
    assumed,
    at_zero,
    inertial,
    joint,
    left,
    link,
    made,
    mass_matrix,
    pair,
    tensor,
    write,
)
from ..small_usd import warned

# ---------------------------------------------------------------- frames


def test_bodies_at_fixed_joints_are_bodies_of_the_model(tmp_path):
    model, conversion = made(tmp_path, link("a") + link("imu") + joint("mount", "a", "imu", "fixed"))
    assert [model.body(i).name for i in range(model.nbody)] == ["world", "a", "imu"]
    assert (conversion.report.bodies, model.nv) == ({"/robot/link[a]": "a", "/robot/link[imu]": "imu"}, 6)


def test_linked_bodies_do_not_touch(tmp_path):
    overlapping = link("a", BOX) + link("b", BOX) + joint("j", "a", "b", "continuous")
    for base in ("fixed", "floating"):
        model, _ = made(tmp_path, overlapping, base)
        assert at_zero(model).ncon == 0


def test_names_that_mujoco_reserves_are_changed(tmp_path):
    model, conversion = made(tmp_path, link("world") + link("b") + joint("j", "world", "b", "continuous"))
    assert [model.body(i).name for i in (1, 2)] == ["world_link", "b"]
    assert assumed(conversion, "MuJoCo keeps the name") == [("/robot/link[world]", "world_link")]


# ---------------------------------------------------------------- base
def test_a_base_floats_by_default_and_the_report_notes_it(tmp_path):
    model, conversion = made(tmp_path, pair("continuous"))
    assert (model.jnt_type[0], conversion.report.base) == (int(mujoco.mjtJoint.mjJNT_FREE), "floating")
    assert assumed(conversion, "does not define its base") == [("/robot/link[a]", "floating")]
    model, conversion = made(tmp_path, pair("continuous"), "fixed")
    assert (model.nv, conversion.report.base) == (1, "fixed")


@pytest.mark.parametrize(
    ("kind", "base", "expected", "freedoms"),
    [
        ("fixed", "auto", "fixed", 0),
        ("fixed", "fixed", "fixed", 0),
        ("fixed", "floating", "floating", 6),
        ("floating", "auto", "floating", 6),
        ("floating", "fixed", "fixed", 0),
        ("prismatic", "auto", "attached", 1),
    ],
)
def test_a_root_link_named_world_is_the_world(tmp_path, kind, base, expected, freedoms):
    robot = f'<link name="world">{BOX}</link>' + link("a") + joint("j", "world", "a", kind, '<origin xyz="0 0 2"/>')
    model, conversion = made(tmp_path, robot, base)
    assert (conversion.report.base, model.nv, model.nbody) == (expected, freedoms, 2)
    assert (len(conversion.description.static_geoms), list(model.geom_bodyid)) == (1, [0])  # ground, not robot
    np.testing.assert_allclose(at_zero(model).body("a").xpos, [0, 0, 2])


# ---------------------------------------------------------------- joints
def test_hinges_and_slides_take_axis_limits_and_passive_forces(tmp_path):
    inside = """<axis xyz="0 0 -1"/><limit lower="-0.5" upper="1.25" effort="30" velocity="12"/>
      <dynamics damping="0.7" friction="0.2"/>"""
    for kind, number in (("revolute", mujoco.mjtJoint.mjJNT_HINGE), ("prismatic", mujoco.mjtJoint.mjJNT_SLIDE)):
        model, conversion = made(tmp_path, pair(kind, inside))
        item = model.joint("j")
        assert item.type[0] == int(number)
        np.testing.assert_array_equal(item.axis, [0, 0, -1])
        np.testing.assert_array_equal(item.range, [-0.5, 1.25])
        np.testing.assert_array_equal(model.jnt_actfrcrange[item.id], [-30, 30])
        assert (model.dof_damping[6], model.dof_frictionloss[6]) == (0.7, 0.2)
        assert conversion.report.velocity_limits == {"j": 12.0}


def test_an_axis_that_is_not_given_is_x_and_only_its_direction_counts(tmp_path):
    model, conversion = made(tmp_path, pair("continuous"))
    np.testing.assert_array_equal(model.joint("j").axis, [1, 0, 0])
    assert assumed(conversion, "no axis") == [("/robot/joint[j]", "1 0 0")]
    model, conversion = made(tmp_path, pair("prismatic", '<axis xyz="0 3 4"/><limit lower="0" upper="1"/>'))
    np.testing.assert_allclose(model.joint("j").axis, [0, 0.6, 0.8])
    assert assumed(conversion, "not of unit length") == [("/robot/joint[j]", "length 5")]


@pytest.mark.parametrize(
    ("kind", "limit", "expected", "warned"),
    [
        ("revolute", 'lower="-1" upper="2"', (-1, 2), False),
        ("continuous", 'lower="-1" upper="2"', None, True),
        ("revolute", 'effort="5" velocity="1"', None, True),
        ("revolute", 'lower="0.5" upper="0.5"', None, True),
        ("revolute", 'lower="2" upper="-1"', None, True),
        ("revolute", 'upper="1.5"', (0, 1.5), False),
        ("prismatic", 'lower="-0.1"', (-0.1, 0), False),
        ("revolute", 'lower="-inf" upper="inf"', None, False),
        ("revolute", 'lower="-1e6" upper="1e6"', None, False),
        ("prismatic", 'lower="0" upper="inf"', (0, 1e6), False),
    ],
)
def test_limits_mean_what_urdf_means_by_them(tmp_path, kind, limit, expected, warned):
    model, conversion = made(tmp_path, pair(kind, f"<limit {limit}/>"))
    item = model.joint("j")
    assert bool(model.jnt_limited[item.id]) is (expected is not None)
    if expected:
        np.testing.assert_array_equal(item.range, expected)
    assert any("limits" in text for text in conversion.report.warnings) is warned


def test_efforts_and_speeds_of_zero_mean_not_given(tmp_path):
    model, conversion = made(tmp_path, pair("continuous", '<limit effort="0" velocity="0"/>'))
    assert not model.jnt_actfrclimited[1]
    assert conversion.report.velocity_limits == {}
    assert {"/robot/joint[j]/limit effort", "/robot/joint[j]/limit velocity"} <= set(left(conversion))


def test_a_planar_joint_slides_in_its_plane_and_turns_about_its_normal(tmp_path):
    model, _ = made(tmp_path, pair("planar", '<axis xyz="0 0 1"/><dynamics damping="2"/>'), "fixed")
    assert [model.joint(i).name for i in range(3)] == ["j_transX", "j_transY", "j_rotZ"]
    np.testing.assert_allclose(model.jnt_axis, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(model.dof_damping, [2, 2, 2])


def test_a_floating_joint_starts_a_tree_of_its_own(tmp_path):
    robot = pair("continuous", '<origin xyz="0 1 0"/>') + link("c")
    robot += joint("k", "b", "c", "floating", '<origin xyz="0 0 1" rpy="0 0 4"/>')
    model, conversion = made(tmp_path, robot, "fixed")
    assert conversion.report.base == "fixed, floating"
    assert [model.joint(i).name for i in range(model.njnt)] == ["j", "c_free"]
    np.testing.assert_allclose(at_zero(model).body("c").xpos, [0, 1, 1])
    np.testing.assert_allclose(model.body("c").quat, [-math.cos(2), 0, 0, -math.sin(2)])  # w is not negative


def test_mimic_joints_follow_with_factor_and_offset(tmp_path):
    wide = '<limit lower="-2" upper="2"/>'
    follower = joint("k", "a", "c", "revolute", f'{wide}<mimic joint="j" multiplier="-2" offset="0.25"/>')
    model, conversion = made(tmp_path, pair(inside=wide) + link("c") + follower)
    assert conversion.description.couplings[0].coefficients == (0.25, -2, 0, 0, 0)
    assert (model.joint(model.eq_obj1id[0]).name, model.joint(model.eq_obj2id[0]).name) == ("k", "j")
    np.testing.assert_array_equal(model.eq_data[0, :5], [0.25, -2, 0, 0, 0])


def test_orders_of_joints_are_breadth_first_and_depth_first(tmp_path):
    pairs = ("ab", "bc", "ad", "de")
    robot = "".join(map(link, "abcde")) + "".join(joint(pair, *pair, "continuous") for pair in pairs)
    model, conversion = made(tmp_path, robot)
    assert conversion.report.dof_order.physx == ("ab", "ad", "bc", "de")
    assert conversion.report.dof_order.mujoco == ("ab", "bc", "ad", "de")
    assert [model.joint(i).name for i in range(1, 5)] == ["ab", "bc", "ad", "de"]


# ---------------------------------------------------------------- mass
def test_inertia_is_turned_from_its_own_frame_into_the_links(tmp_path):
    own = inertial(2, at="1 2 3", rpy=f"0 0 {math.pi / 2}", tensor="0.3 0.4 0.5 0.01 0.02 0.03")
    model, _ = made(tmp_path, link("a", inertial=own))
    assert model.body("a").mass[0] == 2
    np.testing.assert_array_equal(model.body("a").ipos, [1, 2, 3])
    expected = [[0.4, -0.01, -0.03], [-0.01, 0.3, 0.02], [-0.03, 0.02, 0.5]]  # rotated by 90° about z
    np.testing.assert_allclose(tensor(model, "a"), expected, atol=1e-12)


def test_links_without_mass_are_frames_on_what_they_are_welded_to(tmp_path):
    robot = link("a") + '<link name="frame"/>' + joint("mount", "a", "frame", "fixed", '<origin xyz="1 0 0"/>')
    robot += link("foot", BOX, inertial(0)) + joint("f", "a", "foot", "fixed")
    model, conversion = made(tmp_path, robot)
    assert [model.body(name).mass[0] for name in ("a", "frame", "foot")] == [1, 0, 0]
    assert conversion.report.totals["mass"] == 1
    assert [path for path, _ in assumed(conversion, "no mass: a frame")] == ["/robot/link[frame]", "/robot/link[foot]"]


def test_a_link_without_inertial_welded_to_one_with_inertial_weighs_nothing(tmp_path):
    robot = link("base", BOX, inertial="") + link("spacer", inertial="") + link("weight")
    robot += joint("m", "base", "spacer", "fixed") + joint("n", "spacer", "weight", "fixed")
    robot += link("leg") + link("sole", BOX, inertial="") + joint("j", "base", "leg", "continuous")
    model, conversion = made(tmp_path, robot + joint("k", "leg", "sole", "fixed"))
    assert [model.body(name).mass[0] for name in ("base", "spacer", "weight", "leg", "sole")] == [0, 0, 1, 1, 0]
    assert conversion.report.totals["mass"] == 2
    assert not any("kg" in warning for warning in conversion.report.warnings)
    found = {item.subject: item.numbers for item in conversion.report.findings if item.kind == "no_inertial"}
    assert found == {name: {"mass": 0} for name in ("base", "spacer", "sole")}


@pytest.mark.parametrize("signs", [(-1, -1, 1), (1, -1, 1), (-1, -1, -1)])
@pytest.mark.parametrize("rpy", ["0 0 0", "0.3 -0.2 0.5"])
def test_negative_moments_have_the_size_that_the_file_writes(tmp_path, signs, rpy):
    """MuJoCo's reader refuses negative moments, so it reads the same file with positive moments."""
    sizes = (0.0012, 0.00119, 0.00033)
    written, right = (" ".join(str(k * v) for k, v in zip(s, sizes, strict=True)) for s in (signs, (1, 1, 1)))
    wrong, correct = (pair(child=inertial(0.53, rpy=rpy, tensor=f"{text} 0 0 0")) for text in (written, right))
    model, conversion = made(tmp_path, wrong)
    expected = mujoco.MjModel.from_xml_path(str(write(tmp_path, correct, "right")))
    np.testing.assert_allclose(tensor(model, "b"), tensor(expected, "b"), rtol=1e-6, atol=1e-9)
    assert any("without their signs" in text for text in conversion.report.warnings)
    assert not any(item.kind == "impossible_inertia" for item in conversion.report.findings)


def test_a_frame_with_a_negligible_mass_does_not_count_as_mass(tmp_path):
    speck = inertial(4e-15, tensor="2e-27 2e-27 2e-27 0 0 0")
    welded = link("base", BOX, inertial="") + link("imu", inertial=speck) + joint("m", "base", "imu", "fixed")
    model, conversion = made(tmp_path, welded)
    assert model.body("base").mass[0] == pytest.approx(8)  # 0.008 m³ of water
    assert "mass is 8 kg" in conversion.report.warnings[0]
    (found,) = [item for item in conversion.report.findings if item.kind == "no_inertial"]
    assert (found.subject, found.numbers["mass"]) == ("base", pytest.approx(8))


def test_a_root_without_mass_may_float_with_what_is_welded_to_it(tmp_path):
    model, _ = made(tmp_path, '<link name="base"/>' + link("a") + joint("j", "base", "a", "fixed"))
    assert [model.body(name).mass[0] for name in ("base", "a")] == [0, 1]
    np.testing.assert_allclose(np.diag(mass_matrix(model, at_zero(model))), [1, 1, 1, 0.1, 0.1, 0.1])


@pytest.mark.parametrize("links", [("body",), ("base_link", "body")])
def test_the_first_link_with_mass_is_the_root(tmp_path, links):
    above = ("footprint", *links)
    origin = f'<origin xyz="0.1 0 0.3" rpy="0 0 {math.pi / 2}"/>'
    text = "".join(link(name, inertial="") for name in above[:-1]) + link("body") + link("wheel") + link("arm")
    text += "".join(joint(f"f{i}", above[i], above[i + 1], "fixed", origin) for i in range(len(links)))
    text += joint("k", "body", "arm", "continuous")
    text += joint("j", "footprint", "wheel", "continuous", '<origin xyz="0 0.2 0"/>')
    model, conversion = made(tmp_path, text)
    (tmp_path / "fixed").mkdir()
    fixed, _ = made(tmp_path / "fixed", text, "fixed")  # root not replaced
    data, expected = at_zero(model), at_zero(fixed)
    assert model.body("body").parentid == 0
    assert model.jnt_type[model.body("body").jntadr[0]] == mujoco.mjtJoint.mjJNT_FREE
    assert [dof.name for dof in conversion.description.dofs] == [model.joint(i).name for i in range(1, model.njnt)]
    for name in (*above, "wheel", "arm"):
        np.testing.assert_allclose(data.body(name).xpos, expected.body(name).xpos, atol=1e-12)
        np.testing.assert_allclose(data.body(name).xmat, expected.body(name).xmat, atol=1e-12)
    assert assumed(conversion, "no mass: the first link with mass") == [("/robot/link[footprint]", "body")]


def test_a_link_without_inertial_weighs_what_its_colliders_displace(tmp_path):
    shapes = '<collision><origin xyz="0 0 1"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'
    model, _ = made(tmp_path, link("a", shapes, inertial=""))
    assert model.body("a").mass[0] == pytest.approx(6)  # 0.006 m³ of water
    np.testing.assert_allclose(model.body("a").ipos, [0, 0, 1])
    np.testing.assert_allclose(np.diag(tensor(model, "a")), [0.065, 0.05, 0.025])  # m/12 (b² + c²)


def test_a_mass_without_inertia_takes_the_colliders_about_the_written_centre(tmp_path):
    shape = '<collision><geometry><sphere radius="0.5"/></geometry></collision>'
    model, _ = made(tmp_path, link("a", shape, inertial(2, at="0 0 0.1")))
    assert model.body("a").mass[0] == 2
    np.testing.assert_array_equal(model.body("a").ipos, [0, 0, 0.1])
    across = 0.4 * 2 * 0.25 + 2 * 0.01
    np.testing.assert_allclose(np.diag(tensor(model, "a")), [across, across, 0.2], rtol=1e-9)


@pytest.mark.parametrize("written", ["0 0 0 0 0 0", "0 4e-18 0 0 0 -2e-20", "-1e-20 -1e-20 0 0 0 0"])
def test_inertia_that_is_zero_but_for_rounding_is_not_given(tmp_path, written):
    model, _ = made(tmp_path, link("a", "", inertial(2, tensor=written)))
    np.testing.assert_allclose(model.body("a").inertia, 0.4 * 2 * 0.01)


MOVING = link("a") + '<link name="b"/>' + link("c") + joint("j", "a", "b", "continuous")
MOVING += joint("k", "b", "c", "continuous")
NO_MASS = "the link moves, and neither it nor links welded to it have a mass; the model's mass is 1 kg, as in PhysX"
IMPOSSIBLE = "no body has the moments of inertia (1, 1, 3); the model has (1, 1, 2)"


@pytest.mark.parametrize(
    ("robot", "warning"),
    [
        (pair(), "joint[j]: no <limit> means no limits here; other simulators lock such a joint"),
        (
            pair("continuous", '<mimic joint="jj"/>'),
            "joint[j]/mimic: the coupling was left out: there is no joint 'jj'; was 'j' meant?",
        ),
        (link("a", inertial=inertial(1, tensor="1 1 3 0 0 0")), f"link[a]: {IMPOSSIBLE}"),
        (MOVING, f"link[b]: {NO_MASS}"),
    ],
)
def test_what_is_assumed_of_a_defect_is_warned_about(tmp_path, robot, warning):
    assert warned(made(tmp_path, robot)[1]) == (f"/robot/{warning}",)


# ---------------------------------------------------------------- the whole
HINGED = '<origin xyz="1 0 0" rpy="0.1 -0.2 0.3"/><axis xyz="0 0.6 0.8"/><limit lower="-1" upper="1"/>'
SLIDING = '<origin xyz="0 0.5 0" rpy="3 0 0"/><axis xyz="0 0 1"/><limit lower="0" upper="1"/>'
CHAIN = (
    link("a", BOX, inertial(3, at="0.1 0 0", rpy="0.3 0.2 0.1", tensor="0.2 0.3 0.4 0.01 0.02 -0.03"))
    + link("b", BOX, inertial(2, at="0 0.2 0.1", tensor="0.02 0.03 0.04 0 0 0"))
    + link("tool", "", inertial(0.5, tensor="0.01 0.01 0.01 0 0 0"))
    + link("c", '<visual><geometry><sphere radius="0.1"/></geometry></visual>', inertial(1, tensor="1 1 1 0 0 0"))
    + joint("ab", "a", "b", "revolute", HINGED)
    + joint("bt", "b", "tool", "fixed", '<origin xyz="0 0 0.5" rpy="0 1.5 0"/>')
    + joint("tc", "tool", "c", "prismatic", SLIDING)
)


def test_the_model_is_the_one_that_mujoco_itself_reads(tmp_path):
    extension = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'
    theirs = mujoco.MjModel.from_xml_path(str(write(tmp_path, extension + CHAIN, "theirs")))
    ours, _ = made(tmp_path, CHAIN, "fixed")
    assert [ours.body(i).name for i in range(5)] == [theirs.body(i).name for i in range(5)]
    for coordinates in ([0, 0], [0.7, 0.4]):
        data = [at_zero(model) for model in (ours, theirs)]
        for model, item in zip((ours, theirs), data, strict=True):
            item.qpos[:] = coordinates
            mujoco.mj_forward(model, item)
        np.testing.assert_allclose(data[0].xpos, data[1].xpos, atol=1e-12)
        np.testing.assert_allclose(mass_matrix(ours, data[0]), mass_matrix(theirs, data[1]), rtol=1e-9)
    np.testing.assert_allclose(ours.jnt_range, theirs.jnt_range)


EXTRAS = """<gazebo reference="a"><mu1>0.9</mu1></gazebo>
  <transmission name="t"><joint name="j"/></transmission>
  <sensor name="s" type="imu"/>
"""


def test_parts_without_a_place_in_the_model_are_named(tmp_path):
    inside = """<safety_controller k_velocity="3" soft_upper_limit="1"/><calibration rising="0.1"/>
      <limit lower="-1" upper="1" velocity="2"/>"""
    _, conversion = made(tmp_path, pair("continuous", inside) + EXTRAS)
    reasons = left(conversion)
    joint_parts = ("limit lower", "limit upper", "limit velocity", "safety_controller safety_controller")
    parts = [f"joint[j]/{part}" for part in (*joint_parts, "calibration calibration")]
    parts += ["gazebo gazebo", "transmission[t] transmission", "sensor[s] sensor"]
    assert set(reasons) == {f"/robot/{part}" for part in parts}
    values = {item.name: next(iter(item.values.values())) for item in conversion.report.left_out}
    assert values["gazebo"] == "gazebo reference=a, mu1 0.9"


def test_every_attribute_is_read_or_named(tmp_path):
    source = write(tmp_path, CHAIN + EXTRAS)
    report = convert(source, tmp_path / "out.xml").report
    known = {(item.path, item.name) for item in report.mapped}
    known |= {(path, item.name) for item in report.left_out for path in item.values}
    import xml.etree.ElementTree as ET

    def missing(element: ET.Element, path: str) -> list[str]:
        if (path, element.tag) in known and element.tag not in ("link", "joint", "visual", "collision"):
            return []  # omitted
        out = [f"{path}@{name}" for name in element.attrib if (path, name) not in known]
        for child in element:
            name = child.get("name")
            out += missing(child, f"{path}/{child.tag}" + (f"[{name}]" if name else ""))
        return out

    assert missing(ET.parse(source).getroot(), "/robot") == []


# ---------------------------------------------------------------- commands and cache
def test_the_command_takes_a_urdf(tmp_path, capsys):
    source = write(tmp_path, pair("continuous"))
    assert main(["convert", str(source), "-o", str(tmp_path / "out.xml"), "--base", "fixed"]) == 0
    assert "fixed to the world" in capsys.readouterr().out


def test_the_cache_sees_a_change_of_a_mesh(tmp_path):
    source = write(tmp_path, link("a", '<visual><geometry><mesh filename="part.obj"/></geometry></visual>'))
    part, cache = tmp_path / "part.obj", tmp_path / "cache"
    part.write_text(TETRAHEDRON)
    first = convert_cached(source, cache_dir=cache)
    assert (first.fresh, set(first.sources)) == (True, {"bot.urdf", "part.obj"})
    assert first.sources == source_digest(source) == first.report.layers
    assert not convert_cached(source, cache_dir=cache).fresh
    part.write_text(part.read_text().replace("v 0 0 1", "v 0 0 2"))
    assert convert_cached(source, cache_dir=cache).fresh
