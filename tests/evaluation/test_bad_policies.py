"""Test that the gates of the stock pipeline reject deliberately bad policies."""

from __future__ import annotations

import copy
import math
from functools import cache
from typing import Any

import pytest

from evaluation.conftest import balancer, noise, protocol, words, zeros
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.evaluation import Evaluation, evaluate
from wheelleg_exp.evaluation.protocol import metric_names
from wheelleg_exp.evaluation.protocol_options import PROPERTIES
from wheelleg_exp.jobs.pipeline.pipeline_phases import Gate, judge

PHASES = compose(["pipeline=stand_to_terrain"], primary="pipeline").config["pipeline"]["phases"]


KINDS = ("grid", "waves", "obstacles", "stairs", "stairs_inverted", "slope_inverted")
STEPS = words("steps", episodes=1, stand_s=1.0, drive_s=2.0)
WALK = words("walk", episodes=1, horizon_s=3.0, steady_s=1.5, lin_vel_x="[-0.3,0.0,0.3]")
SMALL = {
    "gate_stand": words("stand", episodes=4, horizon_s=4.0, survival_s="[4.0]"),
    "gate_walk": (*WALK, *STEPS),
    "gate_velocity": WALK,
    "walk": (*WALK, *words("walk", ang_vel_z="[-0.5,0.0,0.5]"), *STEPS),
    "push": words("push", episodes=1, iterations=2, highest=0.4, directions=2, at_s=1.1, after_s=2.0),
    "robust": (
        *words("robust", episodes=1, horizon_s=2.0, friction="[0.6]"),
        *words("robust", **dict.fromkeys((name for name in PROPERTIES if name != "friction"), "[]")),
        *words("robust", combined="null", margins="null"),
    ),
    "terrain": (
        "protocol.strip=null",
        *words("terrain", episodes=2, levels=2, horizon_s=2.0),
        *words("terrain.scene.terrain.sub_terrains", **dict.fromkeys(KINDS, "null")),
    ),
}
BAD = {"zeros": zeros, "noise": noise, "wrong sign": balancer(-1.0), "never moves": balancer(0.0)}


short = cache(lambda name: protocol(name, *SMALL[name]))


@pytest.fixture(scope="module")
def found(task):
    """Return a function that evaluates a policy by a protocol, at most once for each pair."""

    @cache
    def of(policy: str, name: str) -> Evaluation:
        make = {**BAD, "good": balancer(1.0)}[policy]
        return evaluate(*task, make, copy.deepcopy(short(name)))

    return of


def gate(phase: str) -> Gate:
    return Gate(**PHASES[phase]["gate"])


def values(evaluation: Evaluation) -> dict[str, Any]:
    return {name: figure["value"] for name, figure in evaluation.as_dict()["metrics"].items()}


@pytest.mark.parametrize("name", SMALL)
def test_the_names_of_all_metrics_are_known_without_a_simulation(task, found, name):
    assert metric_names(*task, short(name)) == list(found("zeros", name).metrics)


@pytest.mark.parametrize("policy", BAD)
@pytest.mark.parametrize("phase", ["walk", pytest.param("velocity", marks=pytest.mark.full), "terrain"])
def test_no_bad_policy_passes_a_gate_of_driving(found, phase, policy):
    asked = gate(phase)
    assert not judge(asked, values(found(policy, asked.protocol))).passed


@pytest.mark.parametrize("policy", ["zeros", "noise"])
def test_a_policy_that_falls_fails_the_gate_of_standing(found, policy):
    verdict = judge(gate("stand"), values(found(policy, "gate_stand")))
    assert not verdict.passed
    assert verdict.why[0] == "stand/survival is 0, but must be at least 1"


def test_who_never_moves_fails_at_driving_alone(found):
    asked = gate("walk")
    never, good = (judge(asked, values(found(policy, "gate_walk"))) for policy in ("never moves", "good"))
    failed = [{line.split()[0] for line in verdict.why} for verdict in (never, good)]
    assert failed[0] - failed[1] == {"walk/skill_vx", "walk/skill_wz"}


SHARES = [f"steps/{name}_share_{axis}" for name in ("settle", "reversal", "stop") for axis in ("vx", "wz")]


def told(evaluation: Evaluation, *starts: str) -> dict[str, float]:
    """Return the finite metrics whose names have the prefix ``starts``."""
    found = {name: value for name, value in values(evaluation).items() if name.startswith(starts)}
    return {name: value for name, value in found.items() if value is not None}


@pytest.mark.parametrize("policy", ["zeros", "noise"])
def test_who_falls_at_once_has_no_success_anywhere(found, policy):
    stood = found(policy, "gate_stand")
    assert stood.value("stand/survival") == 0.0
    assert 0.2 < stood.value("stand/time_to_failure") < 1.3  # The measured times were 0.28 to 1.2 s.
    assert set(stood.episodes["ended_by"]) <= {"base_contact", "leg_contact", "tilt"}
    walked = found(policy, "walk")
    nothing = ("walk/survival", "walk/commandable_area", "walk/in_band", "walk/sign_", "steps/survival")
    assert set(told(walked, *nothing).values()) == {0.0}
    assert {walked.value(name) for name in SHARES} == {0.0}
    assert told(walked, "steps/settle_v", "steps/overshoot", "steps/stop_distance", "walk/error_vx") == {
        "walk/error_vx_with_falls": walked.value("walk/error_vx_with_falls")
    }
    assert max(walked.value("walk/skill_vx"), walked.value("walk/skill_wz")) < 0.0
    pushed = found(policy, "push")
    limits = told(pushed, "push/limit_", "push/recovered")
    assert (len(limits), set(limits.values())) == (11, {0.0})
    robust = dict.fromkeys(("robust/survival", "robust/worst_survival", "robust/nominal/survival"), 0.0)
    assert told(found(policy, "robust"), "robust/").items() >= robust.items()
    ground = told(found(policy, "terrain"), "terrain/success", "terrain/worst_success", "terrain/levels_passed")
    assert set(ground.values()) == {0.0}


def test_a_policy_that_never_moves_has_the_score_of_standing_still(found):
    walked = found("never moves", "walk")
    assert walked.value("walk/survival") == 1.0
    assert walked.value("walk/commandable_area") == pytest.approx(1 / 9)
    for axis, command in (("vx", 0.3), ("wz", 0.5)):
        assert walked.value(f"walk/gain_{axis}") == pytest.approx(0.0, abs=0.05)
        assert walked.value(f"walk/skill_{axis}") == pytest.approx(0.0, abs=0.05)
        assert walked.value(f"walk/error_{axis}") == pytest.approx((6 / 8) ** 0.5 * command, rel=0.1)
    at_the_wheels = math.hypot(0.3, 0.056 * 0.5) * (6 / 8) ** 0.5  # The track of the wheels is 0.112 m.
    assert walked.value("walk/error_wheels") == pytest.approx(at_the_wheels, rel=0.1)
    assert {walked.value(name) for name in SHARES} == {0.0}
    assert told(walked, "steps/stop_", "steps/settle_v", "steps/reversal_v").keys() <= set(SHARES)
    assert found("never moves", "push").value("push/limit_0s") > 0.1


def test_driving_the_wrong_way_is_worse_than_standing(found):
    walked = found("wrong sign", "walk")
    for axis in ("vx", "wz"):
        assert walked.value(f"walk/gain_{axis}") == pytest.approx(-1.0, abs=0.1)
        assert walked.value(f"walk/sign_{axis}") == 0.0
        assert walked.value(f"walk/skill_{axis}") < 0.0
        still = found("never moves", "walk").value(f"walk/error_{axis}")
        assert walked.value(f"walk/error_{axis}") > 1.8 * still
    assert walked.value("walk/commandable_area") <= 1 / 9
    assert {walked.value(name) for name in SHARES} == {0.0}
