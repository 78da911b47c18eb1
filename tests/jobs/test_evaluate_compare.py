"""``wheelleg evaluate`` on several runs, against another and beside the reference: what it prints, keeps, takes up."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from jobs.small import refused, succeed
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.jobs.saved_evaluation import RESULT, read_content, read_evaluation

pytestmark = pytest.mark.train

SHORT = ("protocol.stand.episodes=4", "protocol.stand.horizon_s=1.5", "protocol.stand.survival_s=[0.5,1.5]")
SHORT += ("protocol.resamples=50",)


def evaluated(*words, protocol=SHORT) -> dict:
    return json.loads(succeed("evaluate", *words, *protocol, "--json").out)


def test_a_cached_evaluation_is_read_back_unchanged_and_refused_if_it_is_damaged(run):
    content = evaluated(run.path)
    (folder,) = [path.parent for path in run.evaluation.glob(f"*/{RESULT}")]
    found = read_evaluation(folder)
    assert json.loads(json.dumps(found.as_dict())) == {key: content[key] for key in found.as_dict()}
    assert found.episodes["test"].tolist() == ["stand"] * 4
    assert np.isfinite(found.episodes["time_to_failure_s"]).all()
    (folder / RESULT).write_text("{")
    with pytest.raises(RunDirectoryError, match="broken JSON"):
        read_evaluation(folder)


def test_a_run_versus_a_copy_and_the_reference(run, tmp_path):
    other = shutil.copytree(run.path, tmp_path / "other")
    found = evaluated(run.path, "--against", other, "--reference")
    assert len(found["evaluations"]) == 3
    assert found["verdict"].startswith("No difference between")
    assert {row["interval"]["value"] for row in found["differences"].values()} <= {0.0, None}
    assert read_content(Path(found["evaluations"][2]))["policy"] == "reference"
    assert [a["kind"] for a in run.manifest().data["additions"]] == ["evaluation", "reference", "comparison"]
    again = evaluated(run.path, "--against", "reference", "--kept")
    assert again["evaluations"][0] == found["evaluations"][0]  # taken, not made anew
    assert again["differences"]["stand/survival"]["second"] == 1.0
    assert again["differences"]["stand/survival"]["test"]["test"] == "McNemar"


def test_several_runs_share_one_table(run, tmp_path):
    other = shutil.copytree(run.path, tmp_path / "other")
    out = succeed("evaluate", run.path, other, *SHORT, "--metric", "*/survival", "--metric", "*/time_*").out
    assert [word for word in ("run 1: ", "run 2: other") if word not in out] == []
    survival = next(line for line in out.splitlines() if line.startswith("stand/survival "))
    assert survival.split()[1:3] == ["0", "0"]
    names = [line.split()[0] for line in out.splitlines() if line.startswith("stand/")]
    assert names == ["stand/survival", "stand/time_to_failure"]
    assert "survivl: no metric matches this" in refused("evaluate", run.path, *SHORT, "--metric", "*/survivl")


@pytest.mark.parametrize("words", [["--against", "nosuch"], ["nosuch"], ["--checkpoint", "77"]])
def test_a_missing_run_or_checkpoint_is_reported_before_any_evaluation(run, words):
    assert words[-1] in refused("evaluate", run.path, *words, *SHORT)
    assert not run.evaluation.exists()


def test_one_training_named_twice_does_not_count_as_two_seeds(run):
    assert "is named twice" in refused("evaluate", run.path, run.path, *SHORT)


def test_trainings_of_different_robots_do_not_count_as_one_method():
    assert "RUN: the runs 'tron1a_" in refused("evaluate", "stock:tron1a", "stock:walk", *SHORT)
    against = ("--against", "stock:stand", "--against", "stock:tron1a")
    assert "--against: the runs 'stand_" in refused("evaluate", "stock:walk", *against, *SHORT)


def test_a_cached_evaluation_is_found_under_any_spelling_of_its_protocol(run):
    first = evaluated(run.path)
    again = evaluated(run.path, "protocol=stand", "protocol.stand.episodes=4", "--stored")
    assert again["folder"] == first["folder"]
    other = evaluated(run.path, "seed=7", "--stored")
    assert other["folder"] != first["folder"]
    finer = evaluated(run.path, "env.sim.dt=0.004", "--stored")
    assert finer["folder"] not in (first["folder"], other["folder"])


@pytest.mark.parametrize("words", [("--engines", "mujoco"), ("--engines", "mujoco,mujoco"),
                                   ("--engines", "mujoco,warp", "--reference")])  # fmt: skip
def test_a_comparison_of_engines_needs_two_of_them_alone(run, words):
    assert "does not name two engines, or another option excludes it" in refused("evaluate", run.path, *words, *SHORT)


def test_the_same_policy_is_compared_in_two_engines(run):
    pytest.importorskip("mujoco_warp")
    brief = ("protocol.stand.episodes=2", "protocol.stand.horizon_s=1.1", "protocol.stand.survival_s=[0.5]", SHORT[-1])
    found = evaluated(run.path, "--engines", "mujoco,warp", protocol=brief)
    assert found["verdict"].startswith(("warp confirms mujoco in all", "warp differs from mujoco in"))
    assert {row["outcome"] for row in found["differences"].values()} <= {"", "differs"}
    assert evaluated(run.path, "--engine", "warp", "--stored", protocol=brief)["about"]["engine"] == "warp"
    (one,), (other,) = found["runs"], found["against"]
    assert one["checkpoint_sha256"] == other["checkpoint_sha256"]
