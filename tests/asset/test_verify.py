"""A written model that is not what was described is refused."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import pytest

from wheelleg_exp.asset.writer.verify import verify
from wheelleg_exp.errors import AssetError

from .small_usd import two_links


@pytest.fixture
def pair(tmp_path):
    text = "float physics:lowerLimit = -10\n float physics:upperLimit = 10"
    return two_links(tmp_path, text)


def changed(robot, **changes):
    first, second = robot.bodies
    return replace(robot, bodies=(first, replace(second, **changes)))


def test_the_model_that_was_written_passes(pair):
    model, done = pair
    verify(model, done.description, "bot.usda")


@pytest.mark.parametrize("what", ["mass", "moments", "center_of_mass"])
def test_other_mass_properties_are_refused(pair, what):
    model, done = pair
    body = done.description.bodies[1]
    other = {"mass": 2.0, "moments": (0.1, 0.1, 0.11), "center_of_mass": (0.0, 0.0, 0.01)}[what]
    wrong = changed(done.description, inertial=replace(body.inertial, **{what: other}))
    with pytest.raises(AssetError, match="of b"):
        verify(model, wrong, "bot.usda")


def test_other_limits_are_refused(pair):
    model, done = pair
    dof = done.description.bodies[1].dofs[0]
    wrong = changed(done.description, dofs=(replace(dof, range=(-1.0, 1.0)),))
    with pytest.raises(AssetError, match="range of j"):
        verify(model, wrong, "bot.usda")


def test_a_missing_body_is_refused(pair):
    _, done = pair
    empty = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    with pytest.raises(AssetError, match="has no body"):
        verify(empty, done.description, "bot.usda")
