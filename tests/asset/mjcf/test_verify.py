"""The converter raises an error if the MuJoCo model differs from the robot description."""

from dataclasses import replace

import mujoco
import pytest

from wheelleg_exp.asset import robot_description as rd
from wheelleg_exp.asset.mjcf.compile_mjcf import load, verify
from wheelleg_exp.errors import AssetError

from ..small_usd import MASS, converted, cube_inside, link, two_links, write


@pytest.fixture
def pair(tmp_path):
    text = "float physics:lowerLimit = -10\n float physics:upperLimit = 10"
    return two_links(tmp_path, text)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"mass": 2.0}, "mass of b"),
        ({"moments": (0.1, 0.1, 0.11)}, "inertia of b"),
        ({"center_of_mass": (0.0, 0.0, 0.01)}, "centre of mass of b"),
        ({"pose": rd.Pose((1.0, 0.0, 0.0), (0.6, 0.8, 0.0, 0.0))}, "rotation of b"),
        ({"pose": rd.Pose((1.0, 0.0, 0.1))}, "position of b"),
        ({"parent": None}, "parent of b"),
        ({"range": (-1.0, 1.0)}, "range of j"),
        ({"axis": (0.0, 1.0, 0.0)}, "axis of j"),
        ({"damping": 1.0}, "damping of j"),
    ],
)
def test_a_different_body_or_joint_is_refused(pair, changes, what):
    model, done = pair
    first, body = done.description.bodies
    parts = {"inertial": body.inertial, "dofs": body.dofs[0]}
    owner = next((name for name, part in parts.items() if hasattr(part, next(iter(changes)))), None)
    if owner:
        part = replace(parts[owner], **changes)
        changes = {owner: (part,) if owner == "dofs" else part}
    with pytest.raises(AssetError, match=what):
        verify(model, replace(done.description, bodies=(first, replace(body, **changes))), "bot.usda")


BALL = rd.Geom("g", "/g", "sphere", (0.1,), rd.Pose(), collides=True, drawn=False)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"static_geoms": (BALL,)}, "shapes"),
        ({"static_sites": (rd.Site("s", "/s", rd.Pose()),)}, "sites"),
        ({"exclusions": ()}, "exclusions"),
        ({"closures": (rd.Closure("c", "/c", "weld", ("a", "b"), ((rd.Pose(), rd.Pose()),)),)}, "sites|equalities"),
        ({"couplings": (rd.Coupling("c", "/c", "j", "j", (0.0, 1.0, 0.0, 0.0, 0.0)),)}, "equalities"),
        ({"tendons": (rd.Tendon("t", "/t", joints=(("j", 1.0),)),)}, "tendons"),
        ({"actuators": (rd.Actuator("m", "/m", "joint", "j"),)}, "actuators"),
    ],
)
def test_other_counts_are_refused(pair, changes, what):
    model, done = pair
    with pytest.raises(AssetError, match=what):
        verify(model, replace(done.description, **changes), "bot.usda")


def test_colliders_are_counted_without_self_collision_too(tmp_path):
    root = "PhysicsArticulationRootAPI PhysxArticulationAPI"
    off = MASS + "\n        bool physxArticulation:enabledSelfCollisions = 0"
    model, done = converted(write(tmp_path, link("a", apis=root, mass=off, inside=cube_inside("boundingCube"))))
    assert not done.description.self_collision
    verify(model, done.description, "bot.usda")
    model.geom_conaffinity[:] = 0
    with pytest.raises(AssetError, match="colliders"):
        verify(model, done.description, "bot.usda")


@pytest.mark.parametrize(
    ("inside", "told"),
    [
        ('<body name="b"><freejoint/></body>', "(at 'b')"),
        ('<body name="b"><geom size="1 2 3 4 5 6"/></body>', "(at 'geom')"),
        ('<geom type="mesh" mesh="none"/>', "none"),
    ],
)
def test_errors_of_mujoco_name_the_element_and_not_the_line(tmp_path, inside, told):
    path = tmp_path / "draft.xml"
    path.write_text(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")
    with pytest.raises(AssetError) as caught:
        load(path, "bot.usda")
    assert "'bot.usda'" in caught.value.message
    assert told in caught.value.message
    assert "line" not in caught.value.message
    assert str(tmp_path) not in caught.value.message


def test_a_missing_body_is_refused(pair):
    _, done = pair
    empty = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    with pytest.raises(AssetError, match="lacks an element"):
        verify(empty, done.description, "bot.usda")
