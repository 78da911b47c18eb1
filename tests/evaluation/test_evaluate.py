"""Test protocols on the stock task with scripted policies."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from evaluation.conftest import balancer, noise, not_numbers, protocol, zeros
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation import Evaluation, evaluate
from wheelleg_exp.evaluation.protocol_options import Protocol
from wheelleg_exp.terms.config_sections import read_section

STAND = ("protocol.stand.episodes=4", "protocol.stand.horizon_s=3.0", "protocol.stand.survival_s=[1.0,3.0]")
WALK = (
    "protocol.walk.episodes=2",
    "protocol.walk.horizon_s=5.0",
    "protocol.walk.lin_vel_x=[-0.2,0.0,0.2]",
    "protocol.walk.ang_vel_z=[-0.4,0.0,0.4]",
    "protocol.steps=null",
    "protocol.settle_s=2.5",  # The command starts with the episode.
)


@pytest.fixture(scope="module")
def of_zeros(task) -> Evaluation:
    return evaluate(*task, zeros, protocol("stand", *STAND))


def test_a_policy_that_follows_the_command_has_skill_gain_and_area(task):
    found = evaluate(*task, balancer(1.0), protocol("walk", *WALK))
    assert found.value("walk/survival") == 1.0
    assert found.value("walk/skill_vx") > 0.9
    assert found.value("walk/gain_vx") == pytest.approx(1.0, abs=0.1)
    assert found.value("walk/gain_wz") == pytest.approx(1.0, abs=0.05)
    assert (found.value("walk/sign_vx"), found.value("walk/sign_wz")) == (1.0, 1.0)


@pytest.mark.parametrize("policy", [zeros, noise])
def test_a_bad_policy_falls_within_about_a_second(task, policy):
    found = evaluate(*task, policy, protocol("stand", *STAND))
    assert found.value("stand/survival") == 0.0
    assert 0.2 < found.value("stand/time_to_failure") < 1.3  # The measured times were 0.28 to 1.2 s.
    assert set(found.episodes["ended_by"]) <= {"base_contact", "leg_contact", "tilt"}


def test_actions_that_are_no_numbers_fail_at_once(task, of_zeros):
    found = evaluate(*task, not_numbers, protocol("stand", *STAND))
    assert found.value("stand/time_to_failure") == pytest.approx(1 / 60)
    assert set(found.episodes["ended_by"]) == {"action not finite"}
    assert (found.scenarios_sha256, found.starts_sha256) == (of_zeros.scenarios_sha256, of_zeros.starts_sha256)


def test_the_same_policy_gets_the_same_rows_and_another_seed_other_starts(task, of_zeros):
    again = evaluate(*task, zeros, protocol("stand", *STAND))
    other = evaluate(*task, zeros, protocol("stand", *STAND), seed=7)
    assert again.as_dict() == of_zeros.as_dict()
    assert other.scenarios_sha256 != of_zeros.scenarios_sha256
    assert other.starts_sha256 != of_zeros.starts_sha256


def test_the_reference_stands_as_was_measured_of_it_elsewhere(task):
    found = evaluate(*task, balancer(1.0), protocol("stand", *STAND))
    assert found.value("stand/survival") == 1.0
    assert 0.0004 < found.value("stand/height_rmse") < 0.002  # 1.04 mm
    assert found.value("stand/torque_share_wheels") < 0.05
    assert found.value("stand/wheels_down_share") == 1.0


def test_the_limit_of_the_reference_is_what_was_measured_elsewhere(task):
    words = ("protocol.push.episodes=1", "protocol.push.directions=2", "protocol.push.pulses_s=[0.0]")
    words = (*words, "protocol.push.after_s=2.0", "protocol.push.iterations=6")
    found = evaluate(*task, balancer(1.0), protocol("push", *words))
    limits = found.episodes["limit_m_s"]
    assert limits == pytest.approx(0.32, abs=0.06)  # forwards and backwards
    assert found.episodes["limit_normalised"] == pytest.approx(limits / np.sqrt(9.81 * 0.07), rel=1e-5)
    assert found.value("push/recovered") == 1.0


def test_every_tile_gets_its_episodes_and_who_falls_succeeds_on_none(task):
    words = (
        "protocol.strip=null",
        "protocol.terrain.episodes=2",
        "protocol.terrain.levels=2",
        "protocol.terrain.horizon_s=1.5",
    )
    kinds = [f"protocol.terrain.scene.terrain.sub_terrains.{name}=null" for name in ("grid", "waves", "obstacles")]
    found = evaluate(*task, zeros, protocol("terrain", *words, *kinds))
    names, counts = np.unique(found.episodes["cell_name"], return_counts=True)
    kinds_left = ("rough", "slope", "slope_inverted", "stairs", "stairs_inverted")
    assert set(names) == {f"{kind}/{level}" for kind in kinds_left for level in (0, 1)}
    assert set(counts) == {2}
    assert found.value("terrain/success") == 0.0
    assert {found.value(f"terrain/levels_passed/{kind}") for kind in kinds_left} == {0.0}


def test_a_command_that_is_not_there_is_told_with_those_that_are(task):
    with pytest.raises(ConfigError, match="base_velocity") as caught:
        evaluate(*task, zeros, protocol("stand", *STAND, "protocol.command=base_velocty"))
    assert caught.value.nearest == "base_velocity"


def test_a_protocol_with_an_unknown_key_is_refused(task):
    with pytest.raises(ConfigError, match="episods"):
        evaluate(*task, zeros, {**protocol("stand", *STAND), "episods": 3})


def test_pictures_of_results_are_plain(of_zeros):
    content = of_zeros.as_dict()
    assert content["metrics"]["stand/height_rmse"]["value"] is None  # No robot survived the settling time.
    assert content["about"]["wheels"] == ["l03", "r03"]
    assert content["about"]["profile"] == "article"
    assert torch.is_tensor(content) is False


@pytest.mark.parametrize(
    ("name", "word", "key", "message"),
    [
        ("stand", "protocol.stand=null", "protocol", "the protocol has no test"),
        ("stand", "protocol.settle_s=60", "protocol.stand.horizon_s", "60 s ends before its steps count"),
        ("walk", "protocol.settle_s=15", "protocol.steps.drive_s", "15 s ends before"),
        ("walk", "protocol.walk.ang_vel_z=[]", "protocol.walk.ang_vel_z", "is out of range"),
        ("push", "protocol.push.pulses_s=[]", "protocol.push.pulses_s", "is out of range"),
        ("terrain", "protocol.terrain.size=[4.0]", "protocol.terrain.size", "is out of range"),
        ("robust", "protocol.robust.lin_vel_x=[]", "protocol.robust.lin_vel_x", "is out of range"),
    ],
)
def test_a_protocol_that_would_tell_nothing_is_refused(name, word, key, message):
    node = protocol(name, word)
    with pytest.raises(ConfigError, match=message) as caught:
        read_section(Protocol, node, "protocol")
    assert caught.value.key == key


def test_a_grid_of_steps_may_leave_out_one_axis_but_not_both():
    read_section(Protocol, protocol("walk", "protocol.steps.ang_vel_z=[]"), "protocol")
    none = protocol("walk", "protocol.steps.ang_vel_z=[]", "protocol.steps.lin_vel_x=[]")
    with pytest.raises(ConfigError, match="the step test has no speed") as caught:
        read_section(Protocol, none, "protocol")
    assert caught.value.key == "protocol.steps.lin_vel_x"


def test_an_episode_lasts_at_least_one_control_step(task):
    short = protocol("stand", "protocol.stand.horizon_s=0.001", "protocol.settle_s=0", "protocol.stand.episodes=2")
    assert evaluate(*task, zeros, short).value("stand/time_to_failure") == pytest.approx(0.001, abs=0.02)
