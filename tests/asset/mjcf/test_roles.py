"""Wheels and legs are found by the robot's structure, and give names to MJCF default classes."""

from dataclasses import replace

import numpy as np
import pytest

from wheelleg_exp.asset.mjcf.default_classes import roles_of
from wheelleg_exp.asset.mjcf.mjcf_document import Writer
from wheelleg_exp.asset.robot_description import Body, Dof, Geom, Inertial, Mesh, Pose, RobotDescription

SOLID = Inertial(1.0, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1), (1.0, 0.0, 0.0, 0.0))
Y = (0.0, 1.0, 0.0)
ACROSS = Pose((0.0, 0.0, 0.0), (0.5**0.5, -(0.5**0.5), 0.0, 0.0))  # turns z onto y
LIMITS = (-1.0, 1.0)


def geom(name: str, kind: str = "cylinder", size=(0.1, 0.02), pose: Pose = ACROSS, mesh: str | None = None) -> Geom:
    return Geom(name, f"/{name}", kind, size, pose, collides=True, drawn=False, mesh=mesh)


def body(name: str, parent: str | None, shape: Geom, dof: Dof | None = None) -> Body:
    dofs = () if dof is None else (dof,)
    return Body(name, f"/{name}", parent, Pose(), SOLID, floating=parent is None, dofs=dofs, geoms=(shape,))


def hinge(name: str, limits: tuple[float, float] | None = LIMITS, **more: object) -> Dof:
    return Dof(name, f"/{name}", "hinge", Y, (0.0, 0.0, 0.0), range=limits, **more)


def robot(tip: Geom, limits: tuple[float, float] | None = None, meshes: tuple[Mesh, ...] = ()) -> RobotDescription:
    bodies = (
        body("p", None, geom("trunk", "box", (1.0, 1.0, 1.0))),
        body("q", "p", geom("g1"), hinge("one", damping=1.0)),
        body("s", "q", geom("g2"), hinge("two", damping=1.0)),
        body("t", "s", tip, hinge("three", limits)),
        body("u", "p", geom("g3", "box", (0.1, 0.1, 0.1)), hinge("four", damping=2.0)),
    )
    return RobotDescription("r", bodies, meshes=meshes)


def disc(points: int, radius: float = 0.1, stretch: float = 1.0) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    ring = np.stack([radius * np.cos(angle), np.zeros(points), stretch * radius * np.sin(angle)], axis=1)
    half = np.array([0.0, 0.02, 0.0])
    return Mesh("m", np.concatenate([ring - half, ring + half]), np.zeros((1, 3), dtype=np.int64), solid=True)


def test_a_round_end_that_turns_without_limits_is_a_wheel_and_what_is_above_it_its_leg():
    found = roles_of(robot(geom("tyre")))
    assert found == {"one": "leg", "two": "leg", "three": "wheel", "tyre": "wheel", "g1": "leg", "g2": "leg"}


@pytest.mark.parametrize(
    ("tip", "limits"),
    [
        (geom("tip"), LIMITS),
        (geom("tip", pose=Pose()), None),  # The cylinder lies on its side.
        (geom("tip", pose=replace(ACROSS, position=(0.05, 0.0, 0.0))), None),  # a crank
        (geom("tip", "box", (0.1, 0.1, 0.1)), None),
    ],
    ids=["limits", "across", "off the axis", "a box"],
)
def test_an_end_that_is_not_round_about_its_axis_or_has_limits_is_not_a_wheel(tip, limits):
    assert roles_of(robot(tip, limits)) == {}


def test_a_mesh_is_measured_across_the_axis():
    tip = geom("tip", "mesh", (), Pose(), "m")
    assert roles_of(robot(tip, meshes=(disc(24),)))["three"] == "wheel"
    assert roles_of(robot(tip, meshes=(disc(24, stretch=1.5),))) == {}


def test_classes_are_called_after_what_their_members_are():
    text = Writer(robot(geom("tyre")), "").text()
    assert '<default class="leg">' in text
    assert '<joint name="one" class="leg"' in text
