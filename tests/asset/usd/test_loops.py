"""A joint that closes a loop becomes an equality; the converter reports a loop that it cannot close."""

import mujoco
import numpy as np

from ..small_usd import converted, hinge, link, write

SQUARE = link("a", apis="PhysicsArticulationRootAPI") + link("b", "(1, 0, 0)")
SQUARE += link("c", "(0, 1, 0)") + link("d", "(1, 1, 0)")


def at(name: str, first: str, second: str, pos0: str, pos1: str = "(0, 0, 0)", text: str = "", **options: str) -> str:
    place = f"point3f physics:localPos0 = {pos0}\n point3f physics:localPos1 = {pos1}\n"
    return hinge(name, first, second, text=f'uniform token physics:axis = "Z"\n {place}{text}', **options)


def square(closing: str) -> str:
    joints = at("ab", "a", "b", "(1, 0, 0)") + at("ac", "a", "c", "(0, 1, 0)") + at("bd", "b", "d", "(0, 1, 0)")
    return SQUARE + joints + closing


def violation(model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]


def kinds(model: mujoco.MjModel) -> list[str]:
    return [mujoco.mjtEq(int(kind)).name for kind in model.eq_type]


def test_a_loop_opens_at_the_joint_furthest_from_the_root_with_a_warning(tmp_path):
    model, done = converted(write(tmp_path, square(at("cd", "c", "d", "(1, 0, 0)"))))
    assert {model.joint(i).name for i in range(1, model.njnt)} == {"ab", "ac", "bd"}
    assert kinds(model) == ["mjEQ_CONNECT", "mjEQ_CONNECT"]
    np.testing.assert_allclose(violation(model), 0, atol=1e-9)
    assert any("/bot/cd" in warning and "closes a loop" in warning for warning in done.report.warnings)


def test_in_a_long_loop_the_far_side_opens_whatever_the_order_of_joints(tmp_path):
    ring = "abcdef"
    bodies = link("a", apis="PhysicsArticulationRootAPI") + "".join(link(name) for name in ring[1:])
    pairs = [("d", "e"), ("c", "d"), ("b", "c"), ("a", "b"), ("f", "a"), ("e", "f")]
    model, _ = converted(write(tmp_path, bodies + "".join(at(p + q, p, q, "(0, 0, 0)") for p, q in pairs)))
    depth = {"a": 0}
    for index in range(2, model.nbody):
        depth[model.body(index).name] = 1 + depth[model.body(int(model.body_parentid[index])).name]
    assert depth == {"a": 0, "b": 1, "c": 2, "d": 3, "e": 2, "f": 1}


def test_a_marked_joint_is_the_one_that_closes(tmp_path):
    marked = at("ab", "a", "b", "(1, 0, 0)", text="bool physics:excludeFromArticulation = 1")
    joints = at("ac", "a", "c", "(0, 1, 0)") + at("bd", "b", "d", "(0, 1, 0)") + at("cd", "c", "d", "(1, 0, 0)")
    model, done = converted(write(tmp_path, SQUARE + marked + joints))
    assert {model.joint(i).name for i in range(1, model.njnt)} == {"ac", "bd", "cd"}
    assert not any("closes a loop" in warning for warning in done.report.warnings)


def test_ball_and_fixed_joints_close_loops_as_a_point_and_a_weld(tmp_path):
    for kind, equality, count in (("Spherical", "mjEQ_CONNECT", 3), ("Fixed", "mjEQ_WELD", 6)):
        text = "bool physics:excludeFromArticulation = 1"
        model, _ = converted(write(tmp_path, square(at("cd", "c", "d", "(1, 0, 0)", kind=kind, text=text))))
        assert (kinds(model), len(violation(model))) == ([equality], count)
        np.testing.assert_allclose(violation(model), 0, atol=1e-9)


def test_a_loop_to_the_world_is_held_there(tmp_path):
    pin = at("pin", "a", "b", "(1, 0, 0)", text="bool physics:excludeFromArticulation = 1")
    pin = pin.replace("rel physics:body0 = </bot/a>", "rel physics:body0")
    body = link("a") + link("b", "(1, 0, 0)") + at("ab", "a", "b", "(1, 0, 0)") + pin
    model, _ = converted(write(tmp_path, body))
    assert kinds(model) == ["mjEQ_CONNECT"] * 2
    np.testing.assert_allclose(violation(model), 0, atol=1e-9)


def test_a_slide_that_closes_a_loop_stays_a_joint_and_a_hinge_of_the_loop_opens(tmp_path):
    model, done = converted(write(tmp_path, square(at("cd", "c", "d", "(1, 0, 0)", kind="Prismatic"))))
    joints = {model.joint(i).name: int(model.jnt_type[i]) for i in range(1, model.njnt)}
    assert (joints["cd"], len(joints), kinds(model)) == (mujoco.mjtJoint.mjJNT_SLIDE, 3, ["mjEQ_CONNECT"] * 2)
    np.testing.assert_allclose(violation(model), 0, atol=1e-9)
    assert any("/bot/cd" in warning and "/bot/bd" in warning for warning in done.report.warnings)


def test_a_slide_is_lost_with_a_warning_when_every_other_joint_is_driven(tmp_path):
    options = {"apis": "PhysicsDriveAPI:angular", "text": "float drive:angular:physics:stiffness = 1"}
    joints = at("ab", "a", "b", "(1, 0, 0)", **options) + at("ac", "a", "c", "(0, 1, 0)", **options)
    joints += at("bd", "b", "d", "(0, 1, 0)", **options) + at("cd", "c", "d", "(1, 0, 0)", kind="Prismatic")
    model, done = converted(write(tmp_path, SQUARE + joints))
    assert model.neq == 0
    assert any("/bot/cd" in warning and "left out" in warning for warning in done.report.warnings)
    assert "PhysicsPrismaticJoint" in {item.name for item in done.report.left_out}


def test_limits_and_drives_of_a_closing_joint_are_named(tmp_path):
    text = "bool physics:excludeFromArticulation = 1\n float physics:lowerLimit = -10\n float physics:upperLimit = 10\n"
    text += "float drive:angular:physics:stiffness = 3"
    closing = at("cd", "c", "d", "(1, 0, 0)", apis="PhysicsDriveAPI:angular", text=text)
    _, done = converted(write(tmp_path, square(closing)))
    left = {item.name for item in done.report.left_out if "/bot/cd" in item.values}
    assert {"physics:lowerLimit", "physics:upperLimit", "drive:angular:physics:stiffness"} <= left
    assert any("/bot/cd" in warning and "drive" in warning for warning in done.report.warnings)


def test_a_robot_with_loops_is_not_torn_apart_to_get_zero_into_its_limits(tmp_path):
    bounded = at("ab", "a", "b", "(1, 0, 0)", text="float physics:lowerLimit = 30\n float physics:upperLimit = 60")
    open_chain, done = converted(write(tmp_path, SQUARE[: SQUARE.index('def Xform "c"')] + bounded))
    np.testing.assert_allclose(open_chain.key("home").qpos[-1], np.pi / 6)
    assert any(item.rule == "zero is outside the limits: clamped" for item in done.report.assumptions)
    joints = bounded + at("ac", "a", "c", "(0, 1, 0)") + at("bd", "b", "d", "(0, 1, 0)")
    closed, _ = converted(write(tmp_path, SQUARE + joints + at("cd", "c", "d", "(1, 0, 0)")))
    data = mujoco.MjData(closed)
    mujoco.mj_resetDataKeyframe(closed, data, closed.key("home").id)
    mujoco.mj_forward(closed, data)
    np.testing.assert_allclose(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY], 0, atol=1e-9)
