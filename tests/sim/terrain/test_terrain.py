"""A ground of a user's own, through the base class alone."""

from __future__ import annotations

import pytest
import torch

from wheelleg_exp.errors import ConfigError

pytestmark = pytest.mark.usefixtures("allow_test_terms")
STEP = {
    "_target_": "managers.spies.Step",
    "height": 0.4,
    "static_friction": 0.7,
    "dynamic_friction": 0.5,
    "restitution": 0.0,
}


def test_environments_begin_where_the_ground_says_and_the_robot_stands_on_it(make_env):
    env = make_env("block", scene={"terrain": STEP})
    env.reset()
    assert env.scene.env_origins.tolist() == [[5.0, 0.0, pytest.approx(0.4)], [0, 0, 0]] * 2
    for _ in range(60):
        env.step(torch.zeros(4, 1))
    height = env.scene.robot.data.root_pos_w[:, 2]
    torch.testing.assert_close(height[::2] - height[1::2], torch.full((2,), 0.4), atol=2e-3, rtol=0)


def test_the_robot_gets_the_mean_friction_and_no_part_of_the_ground_does(make_env):
    model = make_env("block", scene={"terrain": STEP}).scene.model
    assert float(model.geom("cube").friction[0]) == pytest.approx((0.8 + 0.7) / 2)
    assert {int(model.geom(name).priority[0]) for name in ("ground", "ground/step")} == {0}


def test_what_is_no_ground_is_refused(make_env):
    with pytest.raises(ConfigError, match=r"env\.scene\.terrain: is no TerrainBase"):
        make_env(scene={"terrain": {"_target_": "managers.spies.Altimeter"}})
    with pytest.raises(ConfigError, match=r"env\.scene\.terrain.*static_friction"):
        make_env(scene={"terrain": {**STEP, "static_friction": -1.0}})
