"""A protocol on the stock task: what scripted policies deserve, and what stays the same for every policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.evaluation import Evaluation, evaluate


@pytest.fixture(scope="module")
def task() -> tuple[dict[str, Any], Path]:
    config = compose(["task=stand"]).config
    return config["env"], prepare_asset(config).output


def protocol(name: str, *words: str) -> dict[str, Any]:
    return compose([f"protocol={name}", "protocol.resamples=20", *words], primary="evaluate").config["protocol"]


def zeros(env):
    return lambda observations: torch.zeros(env.num_envs, env.action_manager.total_action_dim)


def not_numbers(env):
    return lambda observations: torch.full((env.num_envs, env.action_manager.total_action_dim), torch.nan)


STAND = ("protocol.stand.episodes=4", "protocol.stand.horizon_s=2.0", "protocol.stand.survival_s=[1.0,2.0]")


@pytest.fixture(scope="module")
def of_zeros(task) -> Evaluation:
    return evaluate(*task, zeros, protocol("stand", *STAND))


def test_doing_nothing_falls_within_a_second_or_so(of_zeros):
    assert of_zeros.value("stand/survival") == 0.0
    assert 0.2 < of_zeros.value("stand/time_to_failure") < 1.3  # 0.28 to 1.2 s were measured
    assert set(of_zeros.episodes["ended_by"]) <= {"base_contact", "leg_contact", "tilt"}


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
