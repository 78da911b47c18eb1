"""Deliberately bad policies against the gates of the stock pipeline: none gets through one that it should not."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest

from evaluation.conftest import balancer, noise, protocol, zeros
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.evaluation import Evaluation, evaluate
from wheelleg_exp.jobs.pipeline.gate import judge
from wheelleg_exp.jobs.pipeline.settings import Gate

PHASES = compose(["pipeline=stand_to_terrain"], primary="pipeline").config["pipeline"]["phases"]
SMALL = {
    "gate_stand": ("protocol.stand.episodes=4", "protocol.stand.horizon_s=4.0", "protocol.stand.survival_s=[4.0]"),
    "gate_walk": (
        "protocol.walk.episodes=1",
        "protocol.walk.horizon_s=4.0",
        "protocol.walk.steady_s=2.0",
        "protocol.walk.lin_vel_x=[-0.3,0.0,0.3]",
    ),
    "terrain": (
        "protocol.strip=null",
        "protocol.terrain.episodes=2",
        "protocol.terrain.levels=2",
        "protocol.terrain.horizon_s=3.0",
        *(
            f"protocol.terrain.scene.terrain.sub_terrains.{kind}=null"
            for kind in ("grid", "waves", "obstacles", "stairs", "stairs_inverted", "slope_inverted")
        ),
    ),
}
BAD = {"zeros": zeros, "noise": noise, "wrong sign": balancer(-1.0), "never moves": balancer(0.0)}


@pytest.fixture(scope="module")
def found(task):
    """Evaluations by name of the policy and of the protocol, each made once."""

    @cache
    def of(policy: str, name: str) -> Evaluation:
        make = {**BAD, "good": balancer(1.0)}[policy]
        return evaluate(*task, make, protocol(name, *SMALL[name]))

    return of


def gate(phase: str) -> Gate:
    return Gate(**PHASES[phase]["gate"])


def values(evaluation: Evaluation) -> dict[str, Any]:
    return {name: figure["value"] for name, figure in evaluation.as_dict()["metrics"].items()}


@pytest.mark.parametrize("policy", BAD)
@pytest.mark.parametrize("phase", ["walk", "velocity", "terrain"])
def test_no_bad_policy_passes_a_gate_of_driving(found, phase, policy):
    asked = gate(phase)
    assert not judge(asked, values(found(policy, asked.protocol))).passed


@pytest.mark.parametrize("policy", ["zeros", "noise"])
def test_who_falls_does_not_pass_the_gate_of_standing(found, policy):
    verdict = judge(gate("stand"), values(found(policy, "gate_stand")))
    assert not verdict.passed
    assert verdict.why[0] == "stand/survival is 0, and at least 1 is asked for"


def test_who_never_moves_fails_at_driving_alone(found):
    """It stands as well as the one that drives, so what stops it is skill and nothing else."""
    asked = gate("walk")
    never, good = (judge(asked, values(found(policy, "gate_walk"))) for policy in ("never moves", "good"))
    assert {line.split()[0] for line in never.why} - {line.split()[0] for line in good.why} == {
        "walk/skill_vx",
        "walk/skill_wz",
    }


def test_bad_policies_are_worse_in_what_they_are_bad_at(found):
    good = found("good", "gate_walk")
    for policy in BAD:
        bad = found(policy, "gate_walk")
        assert bad.value("walk/commandable_area") < good.value("walk/commandable_area")
        assert bad.value("walk/error_vx_with_falls") > good.value("walk/error_vx_with_falls")
        assert bad.value("walk/skill_vx") < 0.1
    assert found("noise", "gate_walk").value("walk/survival") == 0.0
    assert found("wrong sign", "gate_walk").value("walk/gain_vx") < -0.5
