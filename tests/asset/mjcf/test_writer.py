"""The printed MJCF has each shared attribute once and comments at their elements; the printing time is linear."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effort import bytecodes

from wheelleg_exp.asset import robot_description as rd
from wheelleg_exp.asset.conversion_report import Assumption
from wheelleg_exp.asset.mjcf.compile_mjcf import verify
from wheelleg_exp.asset.mjcf.mjcf_document import Writer
from wheelleg_exp.asset.mjcf.mjcf_elements import number
from wheelleg_exp.errors import AssetError

SOLID = rd.Inertial(1.0, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1), (1.0, 0.0, 0.0, 0.0))
X = (1.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)


def hinge(name: str, **values: object) -> rd.Dof:
    return rd.Dof(name, f"/r/{name}", "hinge", X, ZERO, **values)


def ball(name: str, *, collides: bool = True, **values: object) -> rd.Geom:
    return rd.Geom(name, f"/r/{name}", "sphere", (0.1,), rd.Pose(), collides=collides, drawn=not collides, **values)


def body(name: str, parent: str | None = None, **values: object) -> rd.Body:
    return rd.Body(name, f"/r/{name}", parent, rd.Pose(), SOLID, floating=parent is None, **values)


def robot(*bodies: rd.Body, **values: object) -> rd.RobotDescription:
    return rd.RobotDescription("r", bodies, **values)


def text_of(description: rd.RobotDescription, notes: Iterable[Assumption] = ()) -> str:
    return Writer(description, "", tuple(notes)).text()


def model_of(description: rd.RobotDescription) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(text_of(description))
    verify(model, description, "r")
    return model


def classes_of(description: rd.RobotDescription) -> dict[str, set[str]]:
    root = ElementTree.fromstring(text_of(description))
    found = {c.get("class"): c for c in root.iter("default") if c.get("class")}
    return {name: {child.tag for child in element if child.tag != "default"} for name, element in found.items()}


def legs(*drives: rd.Drive | None) -> rd.RobotDescription:
    parts = [body("trunk")]
    for side, drive in zip(("FL", "FR", "RL", "RR"), drives, strict=False):
        parts.append(body(f"{side}_thigh", "trunk", dofs=(hinge(f"{side}_hip", damping=1.0, drive=drive),)))
        knee = hinge(f"{side}_knee", damping=2.0, drive=drive)
        parts.append(body(f"{side}_shank", f"{side}_thigh", dofs=(knee,)))
    return robot(*parts)


SERVO = rd.Drive("position", 20.0, 0.5, 30.0)
WHEEL = rd.Drive("velocity", 0.0, 0.5, 30.0)


# ------------------------------------------------------------------ classes
def test_defaults_of_all_joints_have_the_robots_name_and_others_a_common_name():
    classes = classes_of(legs(SERVO, SERVO, SERVO, SERVO))
    assert (classes["r"], classes["hip"], classes["knee"]) == ({"position"}, {"joint"}, {"joint"})
    model = model_of(legs(SERVO, SERVO, SERVO, SERVO))
    np.testing.assert_allclose(model.dof_damping[6:], [1, 2] * 4)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 20)
    np.testing.assert_allclose(model.actuator_forcerange, [[-30, 30]] * 8)


def test_a_mujoco_actuator_is_not_changed_by_other_drives():
    parts = list(legs(SERVO, SERVO).bodies)
    parts[1] = replace(parts[1], dofs=(replace(parts[1].dofs[0], drive=None),))
    item = rd.Actuator("own", "/r/own", "joint", "FL_hip", {"gainprm": (7.0,)})
    model = model_of(robot(*parts, actuators=(item,)))
    assert model.actuator("own").gainprm[0] == 7
    np.testing.assert_allclose(model.actuator("own").biasprm, 0)
    assert not model.actuator_forcelimited[model.actuator("own").id]


def test_shapes_share_what_contacts_are_like():
    rubber = {"condim": 6, "priority": 1}
    feet = [body(f"{side}_foot", "a", geoms=(ball(f"{side}_foot", extra=rubber),)) for side in ("l", "r")]
    description = robot(body("a", geoms=(ball("trunk"), ball("skin", collides=False))), *feet)
    assert classes_of(description)["foot_collision"] == {"geom"}
    model = model_of(description)
    contacts = {model.geom(i).name: int(model.geom_condim[i]) for i in range(model.ngeom)}
    assert contacts == {"trunk": 3, "skin": 3, "l_foot": 6, "r_foot": 6}


def test_tendons_equalities_and_sites_share_too():
    extra = {"size": (0.001,), "group": 4}
    sites = tuple(rd.Site(f"s{i}", f"/r/s{i}", rd.Pose((0.0, 0.0, i / 10)), extra) for i in range(3))
    path = [tuple(rd.TendonPoint("site", f"s{i}") for i in pair) for pair in ((0, 1), (1, 2))]
    tendons = tuple(rd.Tendon(f"t{i}", f"/r/t{i}", p, extra={"stiffness": 5.0}) for i, p in enumerate(path))
    one, other = hinge("one"), hinge("other")
    stiff = {"solref": (0.005, 1.0)}
    couplings = tuple(rd.Coupling(f"c{i}", f"/r/c{i}", "one", "other", (0, 1, 0, 0, 0), stiff) for i in range(2))
    description = robot(body("a", sites=sites), body("b", "a", dofs=(one, other)), tendons=tendons, couplings=couplings)
    assert classes_of(description) == {"r": {"site", "tendon", "equality"}}
    model = model_of(description)
    np.testing.assert_allclose(model.tendon_stiffness, 5)
    np.testing.assert_allclose(model.eq_solref, [stiff["solref"]] * 2)
    np.testing.assert_allclose(model.site_group, 4)


def test_a_class_never_takes_the_name_of_another():
    names = (("visual_1", 1.0), ("visual_2", 1.0), ("visual_3", 2.0), ("visual_4", 2.0))
    parts = [body("a")]
    parts += [body(f"b_{name}", "a", dofs=(hinge(name, damping=damping),)) for name, damping in names]
    parts.append(body("c", "a", geoms=(ball("skin", collides=False),)))
    description = replace(robot(*parts), name="visual")
    np.testing.assert_allclose(model_of(description).dof_damping[6:], [1, 1, 2, 2])


def test_classes_of_drives_avoid_names_of_joints():
    parts = [body("a")]
    for i, drive in enumerate((SERVO, SERVO, replace(SERVO, stiffness=50.0), replace(SERVO, stiffness=50.0), WHEEL)):
        for word, damping in (("hip_position", 1.0), ("velocity", 2.0)):
            joint = hinge(f"l{i}_{word}", damping=damping, drive=drive)
            parts.append(body(f"{word}_{i}", "a", dofs=(joint,)))
    model = model_of(robot(*parts))
    np.testing.assert_allclose(model.dof_damping[6:], [1, 2] * 5)
    np.testing.assert_allclose(-model.actuator_biasprm[:, 1], [20, 20, 20, 20, 50, 50, 50, 50, 0, 0])
    np.testing.assert_allclose(-model.actuator_biasprm[:, 2], 0.5)


def test_defaults_of_mujoco_are_not_written():
    plain = {"solref": (0.02, 1.0), "condim": 3, "gap": 0.0}
    text = text_of(robot(body("a", geoms=(ball("g", extra=plain),))))
    assert "solref" not in text
    assert "condim" not in text


# ------------------------------------------------------------------ notes
def test_each_note_is_above_its_element():
    description = robot(body("a", geoms=(ball("g"),)), body("b", "a", dofs=(hinge("j"),)))
    notes = [Assumption("/r/a", "no mass", "1 kg"), Assumption("/r/a", "no inertia", "a sphere")]
    notes += [Assumption("/r/g", "flat", "a box"), Assumption("/r/j", "no axis", "X")]
    notes += [Assumption("/r/j/drive", "below the joint", ""), Assumption("bot.usda", "no upAxis", "Y")]
    lines = [line.strip() for line in text_of(description, notes).splitlines()]

    def before(start: str) -> str:
        return lines[next(i for i, line in enumerate(lines) if line.startswith(start)) - 1]

    assert before('<body name="a"') == "<!-- no mass: 1 kg; no inertia: a sphere -->"
    assert before('<geom name="g"') == "<!-- flat: a box -->"
    assert before('<joint name="j"') == "<!-- no axis: X; below the joint -->"
    head = "\n".join(lines[: lines.index("-->")])
    assert "bot.usda: no upAxis: Y" in head
    assert "/r/" not in head


@pytest.mark.parametrize("rule", ["a -- b", "a---b", "ends in -", "<tag> & \"quotes\" 'here'", "--"])
def test_a_note_may_hold_anything_and_the_file_stays_xml(rule):
    notes = [Assumption("/r/a", rule, ""), Assumption("nowhere", rule, "-")]
    assert ElementTree.fromstring(text_of(robot(body("a")), notes)).tag == "mujoco"


# ------------------------------------------------------------------ size
def chain(count: int) -> rd.RobotDescription:
    parts = [body("b0")]
    parts += [body(f"b{i}", f"b{i - 1}", dofs=(hinge(f"j{i}"),)) for i in range(1, count)]
    return robot(*parts)


def test_the_longest_chain_that_mujoco_reads_is_written():
    assert model_of(chain(496)).nbody == 497


@pytest.mark.parametrize("count", [497, 2000])
def test_a_longer_chain_is_refused_in_words(count):
    with pytest.raises(AssetError, match="chain of about") as refused:
        text_of(chain(count))
    assert "496" in refused.value.expected


def test_time_grows_with_the_number_of_bodies_and_not_with_its_square():
    def effort(count: int) -> int:
        wide = robot(body("b0"), *(body(f"b{i}", "b0", dofs=(hinge(f"j{i}"),)) for i in range(1, count)))
        return bytecodes(lambda: text_of(wide))

    assert effort(1600) < 17 * effort(100)  # Quadratic effort would be 256 times larger.


# ------------------------------------------------------------------ saved states
def test_home_is_the_saved_state_with_its_velocities():
    moving = replace(body("a"), pose=rd.Pose((0.0, 0.0, 2.0)), velocity=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    part = body("b", "a", dofs=(hinge("j", position=0.5, velocity=-1.0, drive=replace(SERVO, target_position=0.25)),))
    key = model_of(robot(moving, part)).key("home")
    np.testing.assert_allclose(key.qpos, [0, 0, 2, 1, 0, 0, 0, 0.5])
    np.testing.assert_allclose(key.qvel, [1, 2, 3, 4, 5, 6, -1])
    np.testing.assert_allclose(key.ctrl, [0.25])


def test_the_home_of_a_file_replaces_the_default():
    own = rd.Keyframe("home", "/r/home", {"qpos": (0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0)})
    model = model_of(robot(body("a"), keyframes=(own,)))
    assert (model.nkey, model.key("home").qpos[2]) == (1, 3)


# ------------------------------------------------------------------ names and numbers
def test_free_joints_and_anchors_take_names_that_are_free():
    loop = rd.Closure("loop", "/r/loop", "connect", ("a", "b"), ((rd.Pose(), rd.Pose()),))
    parts = (body("a", sites=(rd.Site("loop_0_a", "/r/x", rd.Pose()),)), body("b", "a", dofs=(hinge("a_free"),)))
    coupling = rd.Coupling("loop", "/r/c", "a_free", "a_free_2", (0.0, 1.0, 0.0, 0.0, 0.0))
    parts += (body("c", "b", dofs=(hinge("a_free_2"),)),)
    model = model_of(robot(*parts, closures=(loop,), couplings=(coupling,)))
    assert (model.nsite, model.neq, model.njnt) == (3, 2, 3)


def test_a_hinges_loop_is_two_points_and_shares_nothing_with_a_coupling_of_its_name():
    points = tuple((pose, pose) for pose in (rd.Pose(), rd.Pose((0.0, 0.0, 0.1))))
    loop = rd.Closure("k", "/r/k", "connect", (None, "b"), points, {"solref": (0.01, 1.0)})
    coupling = rd.Coupling("k", "/r/c", "one", "other", (0.0, 1.0, 0.0, 0.0, 0.0))
    dofs = (hinge("one"), hinge("other"))
    model = model_of(robot(body("a"), body("b", "a", dofs=dofs), closures=(loop,), couplings=(coupling,)))
    np.testing.assert_allclose(sorted(model.eq_solref[:, 0]), [0.01, 0.01, 0.02])


@pytest.mark.parametrize("value", [0.1, 1 / 3, 1e-30, 123456789.123, -0.0, 1e22, 5e-324])
def test_numbers_read_back_as_they_were(value):
    assert float(number(value)) == value


def test_meshes_and_their_own_attributes():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
    mesh = rd.Mesh("m", points, np.zeros((0, 3), dtype=np.int64), True, {"maxhullvert": 4})
    geom = rd.Geom("g", "/r/g", "mesh", (), rd.Pose(), collides=True, drawn=False, mesh="m")
    model = model_of(robot(body("a", geoms=(geom,)), meshes=(mesh,)))
    assert model.mesh_graphadr[0] >= 0
    assert model.mesh_graph[model.mesh_graphadr[0]] == 4
