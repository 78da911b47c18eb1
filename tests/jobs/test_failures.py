"""A training whose numbers fail: status 3, whose they were, what they came from, and how it goes on."""

from __future__ import annotations

import functools
import itertools
import json
import math
import shutil

import numpy as np
import pytest

from jobs.small import TINY, Trained, copied, only_run, succeed, wheelleg
from wheelleg_exp.mdp import rewards
from wheelleg_exp.run.run_directory import FAILURE, RunDirectory

pytestmark = pytest.mark.train

WORDS = [*TINY, "agent.max_iterations=4", "agent.save_interval=50", "recording.enabled=false"]


def spoil(patch: pytest.MonkeyPatch, calls: range, rows: slice = slice(None)) -> None:
    function, number = rewards.is_alive, itertools.count()

    @functools.wraps(function)
    def spoiled(env):
        found = function(env)
        if next(number) in calls:
            found[rows] = math.nan
        return found

    patch.setattr(rewards, "is_alive", spoiled)


@pytest.fixture(scope="module")
def failing(tmp_path_factory) -> Trained:
    root = tmp_path_factory.mktemp("failing") / "runs"
    with pytest.MonkeyPatch.context() as patch:
        spoil(patch, range(48, 10**9))
        said = wheelleg("train", *WORDS, f"run.root={root}")
    return Trained(RunDirectory.open(only_run(root), root), said)


@pytest.fixture
def failed(failing, tmp_path) -> RunDirectory:
    return copied(failing, tmp_path)


def test_the_training_ends_with_status_3_and_names_the_term_the_iteration_and_a_file_of_its_state(failing):
    words = ["error: env.rewards.alive: numbers of this key were not finite", "by control step 49, in iteration 2"]
    assert [word for word in (*words, FAILURE) if word not in failing.said.err] == []
    assert (failing.said.status, "Traceback" in failing.said.err) == (3, False)
    with np.load(failing.run.path / FAILURE, allow_pickle=False) as arrays:
        about, state = json.loads(str(arrays["about"])), dict(arrays)
    assert (about["key"], about["iteration"]) == ("env.rewards.alive", 2)
    column = about["reward_terms"].index("alive")
    assert np.isnan(state["rewards"][:, column]).all()
    assert np.isfinite(np.delete(state["rewards"], column, axis=1)).all()
    assert np.isfinite(state["state"]).all()
    assert state["env_ids"].tolist() == list(range(16))
    assert (state["action"].shape, state["model.body_mass"].shape[0]) == ((16, 6), 16)


def test_manifest_and_list_show_it_and_the_last_complete_checkpoint_remains(failing):
    manifest = failing.run.manifest().data
    assert (manifest["status"], manifest["failure"]["key"]) == ("failed", "env.rewards.alive")
    assert FAILURE in manifest["files"]
    listed = json.loads(wheelleg("list", "runs", "--root", failing.run.root, "--json").out)
    (run,) = listed if isinstance(listed, list) else listed["runs"]
    assert run["failure"] == manifest["failure"]
    assert "env.rewards.alive" in run["problem"]
    assert [path.name for path in failing.run.checkpoints()] == ["model_0.pt", "model_1.pt"]
    assert failing.run.manifest().results["checkpoint"] == "model_1.pt"


def test_verify_finds_it_sound_and_a_lost_or_changed_file_wrong(failing, failed):
    assert "env.rewards.alive in iteration 2" in succeed("verify", failing.run.path).out
    np.savez(failed.path / FAILURE, about=np.array(json.dumps({"key": "env.sim", "iteration": 2})))
    assert wheelleg("verify", failed.path).status == 1
    (failed.path / FAILURE).unlink()
    assert wheelleg("verify", failed.path).status == 1


def test_a_resume_continues_as_if_the_run_had_not_failed(failed, tmp_path):
    succeed("train", *WORDS, f"run.root={tmp_path / 'straight'}")
    other = only_run(tmp_path / "straight")
    succeed("resume", failed.path)
    assert not (failed.path / FAILURE).exists()
    assert (failed.path / "model_3.pt").read_bytes() == (other / "model_3.pt").read_bytes()
    manifest = failed.manifest().data
    assert "failure" not in manifest
    assert manifest["resumes"][0]["before"]["failure"]["key"] == "env.rewards.alive"
    assert wheelleg("verify", failed.path).status == 0


def test_a_learning_rate_that_blows_up_fails_with_the_algorithms_key(tmp_path):
    said = wheelleg("train", *WORDS, "agent.algorithm.learning_rate=1e30", f"run.root={tmp_path}")
    assert said.status == 3
    assert "error: agent.algorithm: the actor's " in said.err
    assert "in the update of iteration 0" in said.err
    path = only_run(tmp_path)
    assert not list(path.glob("model_*.pt"))
    with np.load(path / FAILURE, allow_pickle=False) as arrays:
        assert arrays["learning_rate"] == pytest.approx(1e30)


def test_a_single_such_episode_is_reported_at_the_end_and_in_the_list(tmp_path, monkeypatch):
    spoil(monkeypatch, range(5, 6), rows=slice(3, 4))
    said = wheelleg("train", *WORDS, "agent.max_iterations=1", f"run.root={tmp_path}")
    note = "episodes that ended because a number was not finite: env.rewards.alive 1"
    assert said.status == 0
    assert note in said.out
    assert note in wheelleg("list", "runs", "--root", tmp_path).out.replace("\n    ", " ")
    path = only_run(tmp_path)
    assert RunDirectory(path).manifest().results["non_finite"] == {"env.rewards.alive": 1}
    shutil.rmtree(path / "exported")
    page = tmp_path / "report.html"
    assert wheelleg("report", path, "-o", page).status == 0
    assert note in page.read_text(encoding="utf-8")


def test_a_play_reports_rewards_that_are_not_finite_and_leaves_their_episodes_out(run, monkeypatch):
    with monkeypatch.context() as patch:
        spoil(patch, range(10**9))
        said = wheelleg("play", run.path, "recording.enabled=false", "--json")
    figures = json.loads(said.out)["figures"]
    assert (said.status, figures["mean_return"], figures["non_finite"]) == (3, None, {"env.rewards.alive": 16})
    assert "error: env.rewards.alive: " in said.err
    spoil(monkeypatch, range(3, 4), rows=slice(3, 4))  # one episode
    said = succeed("play", run.path, "recording.enabled=false", "play.settle_s=0")
    assert "ended by numbers that are not finite: env.rewards.alive  1" in said.out


@pytest.mark.parametrize("agent", ["zero-agent", "random-agent"])
def test_an_agent_reports_rewards_that_are_not_finite(agent, tmp_path, monkeypatch):
    spoil(monkeypatch, range(10**9))
    said = wheelleg(agent, *[*TINY, "recording.enabled=false", f"run.root={tmp_path}", "--steps", "5"])
    assert said.status == 3
    assert "error: env.rewards.alive: " in said.err
    assert "ended by numbers that are not finite: env.rewards.alive" in said.out
