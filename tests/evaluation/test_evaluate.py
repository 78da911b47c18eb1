"""Test protocols on the stock task with scripted policies."""

import numpy as np
import pytest

from evaluation.conftest import balancer, not_numbers, protocol, words, zeros
from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation import Evaluation, evaluate
from wheelleg_exp.evaluation.protocol_options import Protocol
from wheelleg_exp.terms.config_sections import read_section

STAND = words("stand", episodes=4, horizon_s=3.0, survival_s="[1.0,3.0]")
WALK = words("walk", episodes=2, horizon_s=5.0, lin_vel_x="[-0.2,0.0,0.2]", ang_vel_z="[-0.4,0.0,0.4]")
WALK += ("protocol.steps=null", "protocol.settle_s=2.5")  # The command starts with the episode.


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


def test_actions_that_are_no_numbers_fail_at_once(task, of_zeros):
    found = evaluate(*task, not_numbers, protocol("stand", *STAND))
    assert found.value("stand/time_to_failure") == pytest.approx(1 / 60)
    assert set(found.episodes["ended_by"]) == {"action not finite"}
    assert (found.scenarios_sha256, found.starts_sha256) == (of_zeros.scenarios_sha256, of_zeros.starts_sha256)


def test_the_same_policy_gets_the_same_plain_rows_and_another_seed_other_starts(task, of_zeros):
    again = evaluate(*task, zeros, protocol("stand", *STAND))
    other = evaluate(*task, zeros, protocol("stand", *STAND), seed=7)
    content = of_zeros.as_dict()
    assert again.as_dict() == content
    assert other.scenarios_sha256 != of_zeros.scenarios_sha256
    assert other.starts_sha256 != of_zeros.starts_sha256
    assert content["metrics"]["stand/height_rmse"]["value"] is None  # No robot survived the settling time.
    assert (content["about"]["wheels"], content["about"]["profile"]) == (["l03", "r03"], "article")


def test_the_reference_stands_as_in_an_independent_measurement(task):
    found = evaluate(*task, balancer(1.0), protocol("stand", *STAND))
    assert found.value("stand/survival") == 1.0
    assert 0.0004 < found.value("stand/height_rmse") < 0.002  # 1.04 mm
    assert found.value("stand/torque_share_wheels") < 0.05
    assert found.value("stand/wheels_down_share") == 1.0


def test_the_limit_of_the_reference_is_what_was_measured_elsewhere(task):
    short = words("push", episodes=1, directions=2, pulses_s="[0.0]", after_s=2.0, iterations=6)
    found = evaluate(*task, balancer(1.0), protocol("push", *short))
    limits = found.episodes["limit_m_s"]
    assert limits == pytest.approx(0.38, abs=0.03)  # forwards and backwards
    assert found.episodes["limit_normalised"] == pytest.approx(limits / np.sqrt(9.81 * 0.07), rel=1e-5)
    assert found.value("push/recovered") == 1.0


def test_every_tile_gets_its_episodes_and_a_falling_policy_succeeds_on_no_tile(task):
    short = ("protocol.strip=null", *words("terrain", episodes=2, levels=2, horizon_s=1.5))
    kinds = words("terrain.scene.terrain.sub_terrains", **dict.fromkeys(("grid", "waves", "obstacles"), "null"))
    found = evaluate(*task, zeros, protocol("terrain", *short, *kinds))
    names, counts = np.unique(found.episodes["cell_name"], return_counts=True)
    kinds_left = ("rough", "slope", "slope_inverted", "stairs", "stairs_inverted")
    heights = {"rough": ("2mm", "4mm"), **dict.fromkeys(("slope", "slope_inverted"), ("7.5°", "15°"))}
    heights |= dict.fromkeys(("stairs", "stairs_inverted"), ("4mm", "8mm"))
    assert set(names) == {f"{kind}/{height}" for kind in kinds_left for height in heights[kind]}
    assert set(counts) == {2}
    assert found.value("terrain/success") == 0.0
    assert {found.value(f"terrain/levels_passed/{kind}") for kind in kinds_left} == {0.0}


def test_a_policy_with_a_jump_command_drives_onto_the_same_steps_blindly_and_other_policies_skip_them(task):
    jumping = compose(["task=jump", "robot=physical"]).config
    short = [*words("terrain", episodes=1, levels=2, horizon_s=1.5), *words("bump", episodes=2, horizon_s=1.2)]
    short += words("terrain.scene.terrain.sub_terrains", stairs_down="null", stairs_up="null", step_down="null")
    triggers = []

    def noting(env):
        term = env.command_manager.get_term("jump")
        triggers.append((env.num_envs, term.bump is not None))
        return zeros(env)

    made = evaluate(jumping["env"], prepare_asset(jumping).output, noting, protocol("steps", *short))
    assert triggers == [(2, False), (12, True)]
    levels = ("5mm", "10mm", "15mm", "20mm", "25mm", "30mm")
    assert [made.metrics[f"bump/success/step_up/{level}"].episodes for level in levels] == [2] * 6
    without = evaluate(*task, zeros, protocol("steps", *short))
    assert set(without.episodes["test"]) == {"terrain"}
    assert without.metrics["bump/success"].episodes == 0
    assert without.scenarios_sha256 == made.scenarios_sha256
    with pytest.raises(ConfigError, match="has no jump command"):
        evaluate(*task, zeros, protocol("steps", *short, "protocol.terrain=null"))


def test_an_unknown_command_and_an_unknown_key_are_rejected(task):
    with pytest.raises(ConfigError, match="base_velocity") as caught:
        evaluate(*task, zeros, protocol("stand", *STAND, "protocol.command=base_velocty"))
    assert caught.value.nearest == "base_velocity"
    with pytest.raises(ConfigError, match="episods"):
        evaluate(*task, zeros, {**protocol("stand", *STAND), "episods": 3})


NO_TURNS, NO_SPEEDS = "protocol.steps.ang_vel_z=[]", "protocol.steps.lin_vel_x=[]"


@pytest.mark.parametrize(
    ("name", "changes", "key", "message"),
    [
        ("stand", ["protocol.stand=null"], "protocol", "the protocol has no test"),
        ("stand", ["protocol.settle_s=60"], "protocol.stand.horizon_s", "60 s ends before its steps count"),
        ("get_up", ["protocol.get_up.recovered_s=6"], "protocol.get_up.recovered_s", "longer than the time after at_s"),
        ("walk", ["protocol.settle_s=15"], "protocol.steps.drive_s", "15 s ends before"),
        ("walk", ["protocol.walk.ang_vel_z=[]"], "protocol.walk.ang_vel_z", "is out of range"),
        ("walk", [NO_TURNS, NO_SPEEDS], "protocol.steps.lin_vel_x", "the step test has no speed"),
        ("terrain", ["protocol.strip.horizon_s=4.0"], "protocol.strip.horizon_s", "does not reach beyond the strip"),
    ],
)
def test_a_protocol_without_a_result_is_rejected(name, changes, key, message):
    node = protocol(name, *changes)
    with pytest.raises(ConfigError, match=message) as caught:
        read_section(Protocol, node, "protocol")
    assert caught.value.key == key


def test_a_grid_of_steps_may_leave_out_one_axis():
    assert read_section(Protocol, protocol("walk", NO_TURNS), "protocol").steps.ang_vel_z == []


def test_an_episode_lasts_at_least_one_control_step(task):
    short = protocol("stand", "protocol.stand.horizon_s=0.001", "protocol.settle_s=0", "protocol.stand.episodes=2")
    assert evaluate(*task, zeros, short).value("stand/time_to_failure") == pytest.approx(0.001, abs=0.02)
