"""Roots of body trees: a base fixed to the world, or the centre of a floating articulation as in OpenUSD's parser."""

import itertools
import random
import warnings

import mujoco
import numpy as np
import pytest
from pxr import Usd, UsdPhysics

from wheelleg_exp.asset.usd.usd_robot import read_usd

from ..small_usd import MASS, converted, hinge, link, write

AHEAD = "point3f physics:localPos0 = (1, 0, 0)"
MARK = "PhysicsArticulationRootAPI"
CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    upAxis = "Y"'


def roots(model: mujoco.MjModel) -> set[str]:
    return {model.body(i).name for i in range(1, model.nbody) if model.body_parentid[i] == 0}


def openusd_root(path) -> set[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = UsdPhysics.LoadUsdPhysicsFromRange(Usd.Stage.Open(str(path)), ["/"])
    (descriptions,) = (value[1] for key, value in found.items() if "Articulation" in str(key))
    return {prim.name for prim in descriptions[0].rootPrims}


@pytest.mark.parametrize("seed", range(40))
def test_the_root_of_a_floating_articulation_is_that_of_openusd(tmp_path, seed):
    dice = random.Random(seed)
    names = [f"b{i}" for i in range(dice.randint(2, 9))]
    dice.shuffle(names)
    edges = [(names[dice.randrange(i)], names[i]) for i in range(1, len(names))]
    edges = [edge if dice.random() < 0.7 else edge[::-1] for edge in edges]
    dice.shuffle(edges)
    joints = "".join(hinge(f"j{i}", *edge) for i, edge in enumerate(edges))
    path = write(tmp_path, "".join(map(link, sorted(names))) + joints, root_apis=MARK)
    assert roots(converted(path)[0]) == openusd_root(path)


@pytest.mark.parametrize(
    ("bodies", "joints", "root"),
    [  # measured in PhysX 0.7, which searches from the first body by path, not from the first in the file
        ("trunk body", "trunk-body", "body"),
        ("b10 b9", "b10-b9", "b10"),
        ("c b z a", "a-z z-b b-c", "z"),
        ("z a m c", "m-a c-m a-z", "a"),
        ("d a c b", "a-b c-a d-c", "a"),
        ("a b c d e", "b-c !d-b c-d d-e a-b", "d"),  # ! closes a loop, along which PhysX measures distances depth-first
        ("a b c d e", "c-e a-b !a-c a-d b-c", "c"),
    ],
)
def test_of_two_centres_the_root_is_that_of_physx(tmp_path, bodies, joints, root):
    loop = {"!": "bool physics:excludeFromArticulation = 1"}
    pairs = [(pair.strip("!").split("-"), loop.get(pair[0], "")) for pair in joints.split()]
    edges = "".join(hinge(f"j{i}", *pair, text=text) for i, (pair, text) in enumerate(pairs))
    path = write(tmp_path, "".join(map(link, bodies.split())) + edges, root_apis=MARK)
    assert roots(converted(path)[0]) == {root}


CHAIN = "".join(link(name, f"({i}, 0, 0)") for i, name in enumerate("abcde"))
JOINTS = "".join(hinge(p + q, p, q, text=AHEAD) for p, q in zip("abcd", "bcde", strict=True))


def test_a_mark_on_a_body_wins_over_the_middle(tmp_path):
    bodies = (link(name, f"({i}, 0, 0)", apis=MARK if name == "b" else "") for i, name in enumerate("abcde"))
    model, _ = converted(write(tmp_path, "".join(bodies) + JOINTS))
    assert (roots(model), model.jnt_type[0]) == ({"b"}, mujoco.mjtJoint.mjJNT_FREE)


def pin(body0: str, body1: str, more: str = "", kind: str = "Fixed", apis: str = "") -> str:
    joint = hinge("pin", "x", "y", kind=kind, text=more, apis=apis)
    return joint.replace("rel physics:body0 = </bot/x>", body0).replace("rel physics:body1 = </bot/y>", body1)


@pytest.mark.parametrize(
    ("body0", "body1"),
    [
        ("", "rel physics:body1 = </bot/c>"),
        ("rel physics:body0 = </bot/c>", ""),
        ("rel physics:body0 = </bot>", "rel physics:body1 = </bot/c>"),
        ("rel physics:body0 = </bot/stand>", "rel physics:body1 = </bot/c>"),
        ("rel physics:body0 = </bot/c>", "rel physics:body1 = </bot/stand>"),
    ],
)
@pytest.mark.parametrize("mark", ["above", "joint", "none"])
def test_a_fixed_joint_to_the_world_in_every_spelling(tmp_path, body0, body1, mark):
    lifted = 'double3 xformOp:translate = (0, 0, 3); uniform token[] xformOpOrder = ["xformOp:translate"];'
    place = "(2, 0, -3)" if "stand" in body0 + body1 else "(2, 0, 0)"
    more = f"point3f physics:localPos{1 if body0.endswith('</bot/c>') else 0} = {place}"
    joint = pin(body0, body1, more, apis=MARK if mark == "joint" else "")
    text = f'{CHAIN}def Xform "stand" {{ {lifted} }}\n{JOINTS}{joint}'
    model, done = converted(write(tmp_path, text, root_apis=MARK if mark == "above" else ""))
    assert (roots(model), done.report.base, model.nv) == ({"c"}, "fixed", 4)
    np.testing.assert_allclose(model.body("c").pos, [2, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("mark", "kind", "drawn"),
    [
        *[("above", "Fixed", True), ("above", "", True), ("joint", "Fixed", True), ("joint", "", True)],
        *[("body", "Fixed", False), ("none", "Fixed", False)],
    ],
)
@pytest.mark.parametrize("side", [0, 1])
def test_the_root_of_a_fixed_base_stays_where_it_is_drawn(tmp_path, mark, kind, drawn, side):
    """Measured in PhysX 0.7: the joint's frames win only for a mark on the body, or without an articulation."""
    frames = f"point3f physics:localPos{1 - side} = (0.3, 0.1, 0.2)\n point3f physics:localPos{side} = (0, 0, 0.05)"
    ends = ["", ""]
    ends[side] = f"rel physics:body{side} = </bot/base>"
    base = link("base", "(0.5, -0.2, 1)", apis=MARK if mark == "body" else "")
    base = base.replace(
        '["xformOp:translate"]', '["xformOp:translate", "xformOp:rotateZ"]\n double xformOp:rotateZ = 45'
    )
    joint = pin(*ends, frames, kind=kind, apis=MARK if mark == "joint" else "")
    arm = link("arm", "(9, 9, 9)") + hinge("j", "base", "arm", text=AHEAD)
    model, done = converted(write(tmp_path, base + arm + joint, root_apis=MARK if mark == "above" else ""))
    assert (roots(model), model.nv) == ({"base"}, 1)
    place, turn = ([0.5, -0.2, 1], [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)])
    np.testing.assert_allclose(model.body("base").pos, place if drawn else [0.3, 0.1, 0.15], atol=1e-9)
    np.testing.assert_allclose(model.body("base").quat, turn if drawn else [1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(model.body("arm").pos, [1, 0, 0], atol=1e-9)
    assert any("stays where it is drawn" in item.rule for item in done.report.assumptions) is drawn


@pytest.mark.parametrize(("kind", "nv"), [("Revolute", 1), ("Prismatic", 1), ("Spherical", 3), ("", 6)])
def test_other_joints_to_the_world_stay_joints(tmp_path, kind, nv):
    model, _ = converted(write(tmp_path, link("c") + pin("", "rel physics:body1 = </bot/c>", kind=kind)))
    assert model.nv == nv
    assert model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE


def test_a_generic_joint_without_limits_holds_the_base_of_an_articulation(tmp_path):
    path = write(tmp_path, CHAIN + JOINTS + pin("", "rel physics:body1 = </bot/a>", kind=""), root_apis=MARK)
    model, done = converted(path)
    assert model.nv == 4
    assert any("generic joint without limits" in item.rule for item in done.report.assumptions)


def test_an_instanced_articulation_is_read_through_its_proxies(tmp_path):
    inside = link("base") + link("arm", "(1, 0, 0)") + hinge("j", "base", "arm", text=AHEAD)
    inside = inside.replace("/bot/", "/proto/")
    proto = f'class Xform "proto" (prepend apiSchemas = ["PhysicsArticulationRootAPI"])\n{{\n{inside}}}\n'
    one = 'def Xform "{name}" (\n instanceable = true\n prepend references = </proto>\n)\n{{\n}}\n'
    model, _ = converted(write(tmp_path, one.format(name="left") + one.format(name="right"), outside=proto))
    assert roots(model) == {"left_arm", "right_arm"}
    turning = {model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE}
    assert turning == {"left_j", "right_j"}


def test_a_chain_of_a_thousand_links_is_read(tmp_path):
    names = [f"n{i}" for i in range(1000)]
    joints = "".join(hinge(f"j{i}", *pair) for i, pair in enumerate(itertools.pairwise(names)))
    path = write(tmp_path, "".join(map(link, names)) + joints, root_apis=MARK)
    robot, _ = read_usd(path, "auto", {})
    assert (len(robot.bodies), len(robot.dofs)) == (1000, 999)
    assert robot.bodies[0].name == "n499"


# ------------------------------------------------------------------ kinds of bodies
def test_a_kinematic_body_moves_by_mocap_and_carries_what_hangs_on_it(tmp_path):
    base = link("base", "(0, 0, 1)", mass=MASS + "\n bool physics:kinematicEnabled = 1")
    model, _ = converted(write(tmp_path, link("arm", "(1, 0, 1)") + base + hinge("j", "base", "arm", text=AHEAD)))
    assert (model.nmocap, roots(model), model.nv) == (1, {"base"}, 1)


def test_a_kinematic_body_at_the_far_end_pulls_by_an_equality(tmp_path):
    hand = link("hand", "(2, 0, 0)", mass=MASS + "\n bool physics:kinematicEnabled = 1")
    body = link("base") + link("arm", "(1, 0, 0)") + hand + hinge("ba", "base", "arm", text=AHEAD)
    body += hinge("ah", "arm", "hand", kind="Fixed", text=AHEAD)
    model, _ = converted(write(tmp_path, body + pin("", "rel physics:body1 = </bot/base>")))
    assert (roots(model), model.nmocap) == ({"base", "hand"}, 1)
    assert [mujoco.mjtEq(int(kind)).name for kind in model.eq_type] == ["mjEQ_WELD"]


def test_a_switched_off_body_is_part_of_what_is_above_it(tmp_path):
    off = MASS + "\n bool physics:rigidBodyEnabled = 0"
    model, _ = converted(write(tmp_path, link("a", inside=link("b", "(1, 0, 0)", mass=off))))
    assert {model.body(i).name for i in range(1, model.nbody)} == {"a"}


def test_nested_bodies_have_the_poses_of_their_prims(tmp_path):
    joint = hinge("j", "a", "b", text=AHEAD).replace("</bot/b>", "</bot/a/b>")
    model, _ = converted(write(tmp_path, link("a", "(0, 0, 5)", inside=link("b", "(1, 0, 0)")) + joint))
    assert model.body("b").parentid[0] == model.body("a").id
    np.testing.assert_allclose(model.body("b").pos, [1, 0, 0], atol=1e-9)


# ------------------------------------------------------------------ joint targets
def test_a_target_below_a_body_is_that_body_and_its_frame_is_composed(tmp_path):
    frame = """def Xform "flange" {
            double3 xformOp:translate = (1, 0, 0); double xformOp:rotateZ = 90; float3 xformOp:scale = (2, 3, 4)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]
        }"""
    joint = hinge("j", "a", "b", text="point3f physics:localPos0 = (1, 1, 1)").replace("</bot/a>", "</bot/a/flange>")
    model, _ = converted(write(tmp_path, link("a", inside=frame) + link("b", "(9, 9, 9)") + joint))
    np.testing.assert_allclose(model.body("b").pos, [1 - 3, 2, 4], atol=1e-9)  # scaled, then rotated
    np.testing.assert_allclose(model.body("b").quat, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-9)


def test_a_switched_off_joint_is_left_out(tmp_path):
    body = link("a") + link("b") + hinge("j", "a", "b", text="bool physics:jointEnabled = 0")
    model, done = converted(write(tmp_path, body))
    assert roots(model) == {"a", "b"}
    assert "PhysicsRevoluteJoint" in {item.name for item in done.report.left_out}


# ------------------------------------------------------------------ saved velocity
def test_the_velocity_of_a_floating_root_is_in_the_keyframe(tmp_path):
    moving = MASS + "\n vector3f physics:velocity = (100, 200, 300)\n vector3f physics:angularVelocity = (0, 90, 0)"
    turned = '["xformOp:translate", "xformOp:rotateX"]\n double xformOp:rotateX = 90'
    body = link("a", mass=moving).replace('["xformOp:translate"]', turned)
    model, _ = converted(write(tmp_path, body, header=CM))
    speed = model.key("home").qvel
    np.testing.assert_allclose(speed[:3], [1, -3, 2], atol=1e-6)  # y up
    np.testing.assert_allclose(speed[3:], [0, 0, -np.pi / 2], atol=1e-6)  # rotated by 90° about x
