"""Shapes of filtered pairs and filtered collision groups have no contacts in MuJoCo."""

import itertools

import mujoco
import pytest

from ..small_usd import MASS, applied, converted, hinge, link, write

GROUND = 'def Plane "ground" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n token axis = "Z"\n}\n'


def cube(name: str = "cube", more: str = "", apis: str = "") -> str:
    extra = "".join(f', "{api}"' for api in apis.split())
    head = f'def Cube "{name}" (prepend apiSchemas = ["PhysicsCollisionAPI"{extra}])'
    return f"{head}\n{{\n double size = 0.2\n {more}\n}}\n"


def group(name: str, includes: str, filtered: str = "", more: str = "") -> str:
    rel = f"prepend rel physics:filteredGroups = {filtered}" if filtered else ""
    members = f"prepend rel collection:colliders:includes = {includes}"
    return f'def PhysicsCollisionGroup "{name}" {applied("CollectionAPI:colliders")} {{\n{members}\n{rel}\n{more}\n}}\n'


def touching(model: mujoco.MjModel) -> set[frozenset[str]]:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return {frozenset(model.geom(g).name for g in contact.geom) for contact in data.contact}


def pairs(*names: str) -> set[frozenset[str]]:
    return {frozenset(pair.split("+")) for pair in names}


ALL = {frozenset(pair) for pair in itertools.combinations(("a_cube", "b_cube", "c_cube", "world_ground"), 2)}
THREE = link("a", inside=cube()) + link("b", inside=cube()) + link("c", inside=cube()) + GROUND
EXCLUDES = "prepend rel collection:colliders:excludes = [</bot/c>, </bot/ground>]"
MERGE = 'string physics:mergeGroup = "left"'
MERGED = group("one", "</bot/a>", more=MERGE) + group("two", "</bot/b>", "</three>", MERGE) + group("three", "</bot/c>")


@pytest.mark.parametrize(
    ("groups", "gone"),
    [
        ("", []),
        (group("one", "[</bot/a>, </bot/b>]", "</one>"), ["a_cube+b_cube"]),
        (group("one", "</bot/a>", "</two>") + group("two", "</bot/b>"), ["a_cube+b_cube"]),
        (group("one", "</bot/a>", "</two>") + group("two", "</bot/ground>"), ["a_cube+world_ground"]),
        (group("one", "</bot>", "</one>", EXCLUDES), ["a_cube+b_cube"]),
        (MERGED, ["a_cube+c_cube", "b_cube+c_cube"]),
    ],
    ids=["no groups", "of itself", "two bodies", "a body and the ground", "excluded paths", "merged groups"],
)
def test_shapes_of_groups_that_filter_each_other_do_not_touch(tmp_path, groups, gone):
    model, done = converted(write(tmp_path, THREE, outside=groups))
    assert touching(model) == ALL - pairs(*gone)
    assert model.nexclude == len(gone)
    assert not done.report.warnings


def test_inverted_groups_touch_only_what_they_name(tmp_path):
    invert = "bool physics:invertFilteredGroups = 1"
    groups = group("one", "</bot/a>", "</two>", invert) + group("two", "</bot/b>") + group("three", "</bot/c>")
    found = touching(converted(write(tmp_path, THREE, outside=groups))[0])
    assert pairs("a_cube+c_cube").isdisjoint(found)
    assert pairs("a_cube+b_cube") <= found


def test_a_body_of_two_groups_gets_bits_instead_of_an_exclude(tmp_path):
    bodies = link("a", inside=cube("low") + cube("high")) + link("b", inside=cube()) + GROUND
    groups = group("one", "</bot/a/low>", "</two>") + group("two", "</bot/b>")
    model, _ = converted(write(tmp_path, bodies, outside=groups))
    expected = pairs("a_high+b_cube", "a_low+world_ground", "a_high+world_ground", "b_cube+world_ground")
    assert touching(model) == expected


def test_many_bodies_in_groups_get_bits_instead_of_hundreds_of_excludes(tmp_path):
    names = [f"n{i}" for i in range(30)]
    bodies = "".join(link(name, inside=cube()) for name in names)
    groups = group("one", "[" + ", ".join(f"</bot/{name}>" for name in names) + "]", "</one>")
    model, _ = converted(write(tmp_path, bodies + GROUND, outside=groups))
    assert model.nexclude == 0
    assert touching(model) == {frozenset((f"{name}_cube", "world_ground")) for name in names}


QUIET = MASS + "\n        bool physxArticulation:enabledSelfCollisions = 0\n"
ROOT = "PhysicsArticulationRootAPI PhysxArticulationAPI"


TOUCHING = pairs("a_low+b_cube", "a_high+b_cube", "a_low+world_ground", "a_high+world_ground", "b_cube+world_ground")


@pytest.mark.parametrize(
    ("where", "target", "gone"),
    [
        ("body", "</bot/b>", {"a_low+b_cube", "a_high+b_cube"}),
        ("collider", "</bot/b>", {"a_low+b_cube"}),
        ("collider", "</bot/b/cube>", {"a_low+b_cube"}),
        ("collider", "</bot/ground>", {"a_low+world_ground"}),
        ("body", "</bot/ground>", {"a_low+world_ground", "a_high+world_ground"}),
    ],
)
def test_filtered_pairs_of_bodies_and_of_colliders(tmp_path, where, target, gone):
    rel = f"rel physics:filteredPairs = {target}"
    low = cube("low", rel if where == "collider" else "", "PhysicsFilteredPairsAPI")
    mass = MASS + (f"\n{rel}" if where == "body" else "")
    body = link("a", mass=mass, apis="PhysicsFilteredPairsAPI", inside=low + cube("high"))
    model, _ = converted(write(tmp_path, body + link("b", inside=cube()) + GROUND))
    assert touching(model) == TOUCHING - pairs(*gone)


def test_filtered_pairs_of_a_prim_above_bodies_apply_to_all_of_these_bodies(tmp_path):
    left = f'def Xform "left" {applied("PhysicsFilteredPairsAPI")}\n{{\n rel physics:filteredPairs = </bot/c>\n'
    left += link("a", inside=cube()) + link("b", inside=cube()) + "}\n"
    model, _ = converted(write(tmp_path, left + link("c", inside=cube()) + GROUND))
    assert touching(model) == ALL - pairs("a_cube+c_cube", "b_cube+c_cube")


@pytest.mark.parametrize("allowed", ["0", "1"])
def test_inside_an_articulation_joined_bodies_never_touch(tmp_path, allowed):
    root = link("a", apis="PhysicsArticulationRootAPI", inside=cube())
    joint = hinge("j", "a", "b", text=f"bool physics:collisionEnabled = {allowed}")
    model, done = converted(write(tmp_path, root + link("b", inside=cube()) + joint), base="fixed")
    assert touching(model) == set()
    assert any("ignores collisionEnabled" in item.rule for item in done.report.assumptions) is (allowed == "1")


def articulation(*names: str, quiet: bool) -> str:
    first, middle, last = names
    text = link(first, mass=QUIET if quiet else MASS, apis=ROOT, inside=cube()) + link(middle)
    return text + link(last, inside=cube()) + hinge(first + middle, first, middle) + hinge(middle + last, middle, last)


def test_self_collision_that_is_off_goes_for_its_own_articulation_alone(tmp_path):
    body = articulation("a", "b", "c", quiet=True) + articulation("x", "y", "z", quiet=False) + link("l", inside=cube())
    model, _ = converted(write(tmp_path, body + GROUND))
    cubes = [f"{name}_cube" for name in "aczxl"]
    everything = {frozenset(pair) for pair in itertools.combinations([*cubes, "world_ground"], 2)}
    assert touching(model) == everything - pairs("a_cube+c_cube")
